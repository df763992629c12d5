"""There is one list of checks, and it needs no network."""

import subprocess
from pathlib import Path

import yaml

ROOT = Path(__file__).parents[2]


def test_every_check_is_a_program_of_this_environment_or_a_script():
    repositories = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text(encoding="utf-8"))["repos"]
    hooks = [hook for repository in repositories for hook in repository["hooks"]]
    assert {repository["repo"] for repository in repositories} == {"local"}
    assert {hook["language"] for hook in hooks} == {"system"}
    assert {"ruff", "ruff-format", "mypy"} <= {hook["id"] for hook in hooks}
    programs = [part for hook in hooks for part in hook["entry"].split() if "/" in part]
    assert len(programs) >= len(hooks)
    assert [program for program in programs if not (ROOT / program).is_file()] == []


def test_make_lint_runs_that_list_and_nothing_else():
    said = subprocess.run(
        ["make", "--dry-run", "--assume-old=.venv/.installed", "lint"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    )
    commands = [line for line in said.stdout.splitlines() if not line.startswith("make")]
    assert commands == [".venv/bin/pre-commit run --all-files --color=auto"]
