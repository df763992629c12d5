"""Temporary files and children are gone however the program ends."""

import os
import signal
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import pytest

from softtissue_estimator.support.leftovers import run_contained, temporary_folder

PATIENCE_S = 10.0


@pytest.fixture(autouse=True)
def _own_folder(tmp_path, monkeypatch):
    (tmp_path / "scratch").mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "scratch"))


def script(tmp_path, text):
    path = tmp_path / "script.py"
    path.write_text(textwrap.dedent(text))
    return path


def scratch(tmp_path):
    return list((tmp_path / "scratch").iterdir())


def gone(process: int) -> bool:
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except OSError:
        return True


def wait_for(condition):
    end = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < end, "nothing happened"
        time.sleep(0.01)


def test_program_runs_in_the_folder_and_is_heard(tmp_path):
    path = script(tmp_path, "import os, sys; print(os.getcwd(), sys.argv[1:]); sys.exit('told')")
    with temporary_folder() as folder:
        done = run_contained([str(path), "a", "b"], folder, os.environ, PATIENCE_S)
        assert done.stdout.split(maxsplit=1) == [str(folder), "['a', 'b']\n"]
        assert (done.returncode, done.stderr) == (1, "told\n")
    assert scratch(tmp_path) == []


@pytest.mark.parametrize("how", ["time", "kill"])
def test_nothing_is_left_after_a_bad_end(tmp_path, how):
    number = tmp_path / "number"
    path = script(
        tmp_path,
        f"""
        import os, pathlib, signal, subprocess, sys, time
        child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
        pathlib.Path({str(number)!r}).write_text(str(child.pid))
        pathlib.Path("half").write_text("a file")
        {"os.kill(os.getpid(), signal.SIGKILL)" if how == "kill" else "time.sleep(60)"}
        """,
    )
    if how == "time":
        with pytest.raises(subprocess.TimeoutExpired), temporary_folder() as folder:
            run_contained([str(path)], folder, os.environ, 2.0)
        wait_for(lambda: gone(int(number.read_text())))
    else:
        with temporary_folder() as folder:
            assert run_contained([str(path)], folder, os.environ, PATIENCE_S).returncode == -signal.SIGKILL
    assert scratch(tmp_path) == []


def test_lines_are_heard_while_the_program_runs(tmp_path):
    path = script(
        tmp_path,
        """
        import pathlib, sys, time
        print("first", flush=True)
        while not pathlib.Path("heard").exists():
            time.sleep(0.01)
        sys.stdout.write("second\\n" + 70_000 * "x" + "\\nno end of line")
        """,
    )
    heard = []
    with temporary_folder() as folder:

        def hear(line):
            heard.append(line)
            (folder / "heard").touch()

        assert run_contained([str(path)], folder, os.environ, PATIENCE_S, hear).returncode == 0
    assert heard == ["first", "second", 70_000 * "x"]


def test_program_that_says_nothing_still_ends_in_time(tmp_path):
    path = script(tmp_path, "import time; time.sleep(60)")
    with pytest.raises(subprocess.TimeoutExpired), temporary_folder() as folder:
        run_contained([str(path)], folder, os.environ, 0.5, print)


@pytest.mark.parametrize("patience", ["orderly", "stubborn"])
def test_child_may_clean_up_but_not_take_its_time(tmp_path, patience):
    number, trace = tmp_path / "number", tmp_path / "trace"
    trace.touch()
    path = script(
        tmp_path,
        f"""
        import os, pathlib, signal, time
        def end(*_):
            {"time.sleep(60)" if patience == "stubborn" else ""}
            pathlib.Path({str(trace)!r}).unlink()
            os._exit(0)
        signal.signal(signal.SIGTERM, end)
        pathlib.Path({str(number)!r}).write_text(str(os.getpid()))
        time.sleep(60)
        """,
    )
    parent = f"""
    import os, threading, time
    from pathlib import Path
    from softtissue_estimator.support.leftovers import clear, run_contained
    threading.Thread(
        target=run_contained, args=([{str(path)!r}], {str(tmp_path)!r}, os.environ, 60.0), daemon=True
    ).start()
    while not Path({str(number)!r}).exists() or not Path({str(number)!r}).read_text():
        time.sleep(0.01)
    began = time.monotonic()
    clear()
    print(time.monotonic() - began, flush=True)
    os._exit(0)
    """
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(parent)],
        timeout=30.0,
        check=True,
        capture_output=True,
        text=True,
    )
    wait_for(lambda: gone(int(number.read_text())))
    assert trace.exists() == (patience == "stubborn")
    assert float(done.stdout) < 2.0


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere a child does not learn of its parent's end")
@pytest.mark.parametrize("end", ["leave", "kill"])
def test_program_that_ends_takes_its_children_along(tmp_path, end):
    number = tmp_path / "number"
    path = script(
        tmp_path,
        f"import os, pathlib, time; pathlib.Path({str(number)!r}).write_text(str(os.getpid())); time.sleep(60)",
    )
    parent = f"""
    import os, tempfile, threading, time
    from pathlib import Path
    tempfile.tempdir = {str(tmp_path / "scratch")!r}
    from softtissue_estimator.support.leftovers import clear, run_contained, temporary_folder
    def work():
        with temporary_folder() as folder:
            run_contained([{str(path)!r}], folder, os.environ, 60.0)
    threading.Thread(target=work, daemon=True).start()
    while not Path({str(number)!r}).exists() or not Path({str(number)!r}).read_text():
        time.sleep(0.01)
    {"clear()" if end == "leave" else "os.kill(os.getpid(), 9)"}
    os._exit(0)
    """
    subprocess.run([sys.executable, "-c", textwrap.dedent(parent)], timeout=30.0, check=False)
    wait_for(lambda: gone(int(number.read_text())))
    if end == "leave":
        assert scratch(tmp_path) == []
        return
    # Killed, it could not clean up: the next program does, once nobody can need it.
    (left,) = scratch(tmp_path)
    with temporary_folder():
        assert left.exists(), "young"
    os.utime(left, (time.time() - 4000.0,) * 2)
    with temporary_folder():
        assert not left.exists()
