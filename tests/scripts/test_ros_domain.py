"""ROS domains that nobody else on this machine uses, also while other runs ask for theirs."""

import os
import signal
import socket
import subprocess
import sys
from pathlib import Path

import pytest

import ros_domain
from ros_domain import DOMAIN, DOMAINS, RANGE, environment_of, reserve, reserved

SCRIPT = Path(ros_domain.__file__)
SAY = "import os; print(os.environ['ROS_DOMAIN_ID'], os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'], flush=True)"


@pytest.fixture
def three(monkeypatch):
    """Three domains to be all that there are, kept from others meanwhile."""
    with reserved() as one, reserved() as two, reserved() as three:
        monkeypatch.setattr(ros_domain, "DOMAINS", (one, two, three))
        monkeypatch.setattr(ros_domain, "_NAME", f"softtissue-test-{os.getpid()}")
        yield {one, two, three}


def start(code, **variables):
    environment = {name: value for name, value in os.environ.items() if name not in (DOMAIN, RANGE)}
    command = [sys.executable, str(SCRIPT), sys.executable, "-c", code]
    return subprocess.Popen(
        command, env=environment | variables, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )


def said(process):
    return process.stdout.readline().split()


def test_every_domain_is_given_once_until_it_is_released(three):
    first, second, third = (reserve() for _ in three)
    assert {first.domain, second.domain, third.domain} == three
    with pytest.raises(RuntimeError, match="expected a free ROS domain"):
        reserve()
    second.release()
    with reserved() as again:
        assert again == second.domain
    for reservation in (first, third):
        reservation.release()


def test_domains_are_taken_in_turn(three):
    found = []
    for _ in range(4):
        with reserved() as domain:
            found.append(domain)
    assert set(found[:3]) == three and found[3] == found[0]


@pytest.mark.parametrize("port", [0, 10, 11, 24])
def test_domain_of_a_program_that_reserved_nothing_is_left_to_it(three, port):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as listener:
        # As DDS binds the port that the programs of a domain share.
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        taken = min(three)
        listener.bind(("", 7400 + 250 * taken + port))
        with reserved() as one, reserved() as other:
            assert {one, other} == three - {taken}
            with pytest.raises(RuntimeError):
                reserve()


def test_a_command_is_in_a_domain_that_lasts_as_long_as_it_does():
    command = start(SAY + "; input()")
    domain, reach = said(command)
    assert int(domain) in DOMAINS and reach == "LOCALHOST"
    name = f"\0softtissue-ros-domain-{domain}"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as holder:
        with pytest.raises(OSError, match="in use"):
            holder.bind(name)
        command.send_signal(signal.SIGKILL)
        command.wait(10.0)
        holder.bind(name)
    command.stdin.close()
    command.stdout.close()


def test_many_commands_at_once_have_a_domain_each():
    commands = [start(SAY + "; input()") for _ in range(12)]
    domains = [said(command)[0] for command in commands]
    for command in commands:
        command.communicate("\n", timeout=10.0)
    assert len(set(domains)) == len(commands)


def test_a_domain_that_is_named_is_taken():
    command = start(SAY, **{DOMAIN: "7", RANGE: "SUBNET"})
    assert command.communicate(timeout=10.0)[0].split() == ["7", "SUBNET"]


def test_tests_run_in_a_domain_of_their_own():
    domain = int(os.environ[DOMAIN])
    assert {DOMAIN: os.environ[DOMAIN], RANGE: os.environ[RANGE]} == environment_of(domain)
    assert domain in DOMAINS
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as other, pytest.raises(OSError, match="in use"):
        other.bind(f"\0softtissue-ros-domain-{domain}")


def test_command_that_is_not_there_is_named_in_a_sentence():
    result = subprocess.run(
        [sys.executable, SCRIPT, "no_such_command"], capture_output=True, text=True, check=False
    )
    assert (result.returncode, result.stderr) == (
        1,
        "error: expected a command, got 'no_such_command': No such file or directory\n",
    )


def test_what_killed_programs_left_in_a_domain_is_removed_before_it_is_reserved_again(tmp_path, monkeypatch):
    monkeypatch.setattr(ros_domain, "_SHARED_MEMORY", tmp_path)
    monkeypatch.setattr(ros_domain, "_turn", iter(range(len(ros_domain.DOMAINS) * 2)))
    kept = ["fastdds_port99999", "fastdds_0000bd5ecb358b00", "somebody_elses"]
    reservation = ros_domain.reserve()
    first = 7400 + 250 * reservation.domain
    reservation.release()
    left = [
        f"fastdds_port{first + 11}",
        f"fastdds_port{first + 11}_el",
        f"sem.fastdds_port{first + 11}_mutex",
    ]
    for name in (*left, *kept):
        (tmp_path / name).touch()
    monkeypatch.setattr(ros_domain, "_turn", iter([ros_domain.DOMAINS.index(reservation.domain)] * 100))
    again = ros_domain.reserve()
    again.release()
    assert again.domain == reservation.domain
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(kept)
