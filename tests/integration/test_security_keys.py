"""The shipped policy with real keys: who may publish and hear what, and what a participant without keys hears.

ROS 2's wheels have no Fast DDS with security; Debian's package libfastrtps-dev has one, with the same plugins.
"""

import shutil
import subprocess
from fnmatch import fnmatchcase
from pathlib import Path

import pytest

from integration.sros2_policy import ENCLAVES, dds_topics, write_keystore
from ros_domain import reserved

pytestmark = [
    pytest.mark.skipif(
        not Path("/usr/include/fastrtps/types/DynamicPubSubType.h").is_file(),
        reason="no Fast DDS with security: Debian's libfastrtps-dev is not installed",
    ),
    pytest.mark.skipif(
        not shutil.which("openssl") or not shutil.which("c++"), reason="no openssl or no C++ compiler"
    ),
    pytest.mark.timeout(300),
]
STATUS, CLOUDS = "rt/softtissue_estimator/status", "rt/surface_points"
WITH_KEY, WITHOUT = 1, 2


@pytest.fixture(scope="module")
def secured(tmp_path_factory):
    """A function that starts a participant: with the keys of an enclave, or None, and its task."""
    folder = tmp_path_factory.mktemp("keys")
    program = folder / "secured_participant"
    source = Path(__file__).with_suffix("").parent / "secured_participant.cpp"
    flags = ["-std=c++17", "-O0", "-o", program, source, "-lfastrtps", "-lfastcdr"]
    # The system's libraries, not those of the ROS 2 wheels.
    environment = {"PATH": "/usr/bin:/bin", "HOME": str(folder)}
    subprocess.run(["c++", *flags], check=True, env=environment)
    (folder / "keystore").mkdir()
    with reserved() as domain:
        write_keystore(folder / "keystore", domain)

        def start(enclave: str | None, *task: object) -> subprocess.Popen:
            keys = "-" if enclave is None else folder / "keystore" / enclave
            command = [program, str(domain), keys, *(str(word) for word in task)]
            pipe = subprocess.PIPE
            return subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=pipe, text=True, env=environment)

        yield start


def candidates() -> list[tuple[str, str]]:
    """Whatever any enclave may publish or subscribe, and one that nobody may; what stands for * is a word."""
    topics = {topic for enclave in ENCLAVES for topics in dds_topics(enclave).values() for topic in topics}
    names = sorted(topic.replace("*parameter*", "set_parameters").replace("*", "word") for topic in topics)
    return [(act, name) for act in ("publish", "subscribe") for name in [*names, "rt/cmd_vel"]]


@pytest.mark.parametrize("enclave", ENCLAVES)
def test_enclave_may_what_the_policy_says_and_nothing_else(secured, enclave):
    asked = candidates()
    with secured(enclave, "may") as participant:
        answers, errors = participant.communicate("".join(f"{act} {name}\n" for act, name in asked), 120.0)
    assert participant.returncode == 0, errors
    said = dict(zip(asked, answers.split(), strict=True))
    expected = {
        (act, name): "yes" if any(fnmatchcase(name, topic) for topic in dds_topics(enclave)[act]) else "no"
        for act, name in asked
    }
    assert set(expected.values()) == {"yes", "no"}
    assert said == expected


def heard(secured, enclave: str | None, topic: str, publishers: dict[int, str | None]) -> set[int]:
    """Values that a participant hears until 2 s after the first one, of those that others publish."""
    sources = [secured(other, "publish", topic, value) for value, other in publishers.items()]
    try:
        with secured(enclave, "hear", topic) as listener:
            values, errors = listener.communicate(timeout=120.0)
        assert listener.returncode == 0, errors
        assert [source.poll() for source in sources] == [None] * len(sources)
    finally:
        for source in sources:
            source.kill()
            source.communicate()
    return {int(value) for value in values.split()}


def test_node_hears_the_tracker_and_nobody_without_keys(secured):
    assert heard(secured, "node", CLOUDS, {WITHOUT: None, WITH_KEY: "tracker"}) == {WITH_KEY}


def test_display_hears_the_node_and_nobody_without_keys_does(secured):
    assert heard(secured, "display", STATUS, {WITHOUT: None, WITH_KEY: "node"}) == {WITH_KEY}
    assert heard(secured, None, STATUS, {WITHOUT: None, WITH_KEY: "node"}) == {WITHOUT}
