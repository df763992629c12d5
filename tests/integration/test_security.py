"""The shipped policy of SROS2 is that of what the node opens, and where security is enforced nothing runs without it.

The ROS 2 wheels have a Fast DDS without security: keys are tried in test_security_keys.py.
"""

import os
from fnmatch import fnmatchcase

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not there; run the tests through `make test`")
pytest.importorskip("softtissue_msgs", reason="the workspace is not built or not sourced")

from std_msgs.msg import String

from integration.harness import Client, NodeProcess, PlainClient, executable, write_organ
from integration.sros2_policy import ACTS, ENCLAVES, allowed, policy

NODE = "softtissue_estimator"
ROLES = [enclave for enclave in ENCLAVES if enclave != "node"]
# Of the node's own expressions: what a full installation has on top.
ONLY_WITH_TF2 = {"/tf", "/tf_static"}


def names(pairs) -> set[str]:
    return {name for name, _types in pairs}


def test_policy_has_the_enclaves_and_allows_what_it_names_alone():
    assert [e.get("path") for e in policy().iter("enclave")] == [f"/softtissue/{e}" for e in ENCLAVES]
    parts = {
        (part.tag, act) for part in policy().iter() for act, rule in part.attrib.items() if rule == "ALLOW"
    }
    assert parts == set(ACTS)
    assert all(name.text.startswith(("/", "~/")) and name.text != "/*" for name in policy().iter("topic"))


def test_node_may_do_what_it_does_and_nothing_else(tmp_path, domain):
    organ = write_organ(tmp_path / "organ")
    with NodeProcess(domain, tmp_path, {"organ": organ, "estimator": "elastic"}), Client(domain) as client:
        client.wait_until_connected()
        graph = client.node
        client.wait(lambda: (NODE, "/") in graph.get_node_names_and_namespaces(), f"{NODE} in the graph")
        opened = {
            "publish": names(graph.get_publisher_names_and_types_by_node(NODE, "/")),
            "subscribe": names(graph.get_subscriber_names_and_types_by_node(NODE, "/")),
            "reply": names(graph.get_service_names_and_types_by_node(NODE, "/")),
            "request": names(graph.get_client_names_and_types_by_node(NODE, "/")),
        }
    may = allowed("node")
    for act in ("subscribe", "publish"):
        may[act] -= ONLY_WITH_TF2 - opened[act]
    assert may == opened


IMAGE_TOPICS = {"/image", "/image/compressed", "/camera_info"}


@pytest.mark.parametrize(
    ("program", "library", "says", "parameters", "not_opened"),
    [
        (
            "overlay",
            "cv2",
            "drawing on images",
            {"image_transport": "raw"},
            {"subscribe": {"/image/compressed"}},
        ),
        (
            "overlay",
            "cv2",
            "drawing on images",
            {"image_transport": "compressed"},
            {"subscribe": {"/image"}},
        ),
        (
            "viewer",
            "viser",
            "serving http",
            {"port": 0, "image_transport": "raw"},
            {"subscribe": {"/image/compressed"}},
        ),
        (
            "viewer",
            "viser",
            "serving http",
            {"port": 0, "image_transport": "compressed"},
            {"subscribe": {"/image"}},
        ),
        (
            "viewer",
            "viser",
            "serving http",
            {"port": 0, "buttons": False},
            {"subscribe": IMAGE_TOPICS, "request": allowed("viewer")["request"]},
        ),
        ("igtl_bridge", "pyigtl", "OpenIGTLink on 127.0.0.1, port", {"port": 0}, {}),
    ],
)
def test_program_may_do_what_it_does_and_nothing_else(
    tmp_path, domain, program, library, says, parameters, not_opened
):
    pytest.importorskip(library, reason=f"the packages of {program} are not installed")
    name = f"softtissue_{program}"
    with (
        NodeProcess(domain, tmp_path, parameters, [executable(program)]) as process,
        PlainClient(domain) as client,
    ):
        process.wait_for_text(says)
        client.wait(lambda: name in client.node.get_node_names(), program)
        client.spin(0.5)
        graph = client.node
        opened = {
            "publish": names(graph.get_publisher_names_and_types_by_node(name, "/")),
            "subscribe": names(graph.get_subscriber_names_and_types_by_node(name, "/")),
            "reply": names(graph.get_service_names_and_types_by_node(name, "/")),
            "request": names(graph.get_client_names_and_types_by_node(name, "/")),
        }
    may = allowed(program)
    may["subscribe"] -= ONLY_WITH_TF2 - opened["subscribe"]
    assert opened == {act: names - not_opened.get(act, set()) for act, names in may.items()}


def test_recorder_may_do_what_it_does_and_nothing_else(tmp_path, domain):
    name, may = "softtissue_recorder", allowed("recorder")
    with PlainClient(domain) as client:
        # It hears what somebody publishes.
        publishers = [client.node.create_publisher(String, topic, 1) for topic in sorted(may["subscribe"])]
        command = [executable("record"), "--out", tmp_path / "bag"]
        with NodeProcess(domain, tmp_path, {}, command) as process:
            for publisher in publishers:
                process.wait_for_text(f"records {publisher.topic_name}\n")
            graph = client.node
            client.wait(lambda: name in graph.get_node_names(), "recorder")
            client.spin(0.5)
            opened = {
                "publish": names(graph.get_publisher_names_and_types_by_node(name, "/")),
                "subscribe": names(graph.get_subscriber_names_and_types_by_node(name, "/")),
                "reply": names(graph.get_service_names_and_types_by_node(name, "/")),
                "request": names(graph.get_client_names_and_types_by_node(name, "/")),
            }
    assert opened == may


def test_roles_together_reach_all_that_the_node_offers_and_each_its_own_alone():
    node, roles = allowed("node"), {role: allowed(role) for role in ROLES}

    def may(role: str, act: str, name: str) -> bool:
        return any(fnmatchcase(name, expression) for expression in roles[role][act])

    def who(act: str, name: str) -> set[str]:
        return {role for role in ROLES if may(role, act, name)}

    images = ("/image", "/camera_info", "/instrument_mask")
    for topic in ("/surface_points", "/correspondences", "/camera_pose", *images, "/tool"):
        assert who("publish", topic) == {"tracker"}
    for topic in ("/registration", "/registration_with_covariance"):
        assert who("publish", topic) == {"registration"}
    about_points = {f"/{NODE}/{name}" for name in ("warp_points", "distance")}
    for service in about_points:
        assert who("request", service) == {"display"}
    for topic in ("deformed_points", "deformed_surface", "registration"):
        hear = {"display", "overlay", "viewer", "igtl_bridge", "recorder"}
        assert who("subscribe", f"/{NODE}/{topic}") == hear
    # The viewer has buttons for those, and for no others.
    buttons = {f"/{NODE}/{name}" for name in ("register", "reset", "load_organ")}
    assert roles["viewer"]["request"] == buttons
    about_registration = {f"/{NODE}/{name}" for name in ("register", "decide_registration")}
    for service in about_registration:
        assert who("request", service) - {"viewer"} == {"registration"}
    for service in node["reply"] - about_points - about_registration:
        assert who("request", service) - {"viewer"} == {"operator"}, service
    # It records what the node hears and says, and nothing else.
    assert roles["recorder"]["subscribe"] - node["subscribe"] <= node["publish"]
    assert roles["recorder"]["subscribe"] >= node["subscribe"]
    for topic in node["publish"]:
        assert who("subscribe", topic) - {"tracker", "registration"}, topic
        if topic.startswith(f"/{NODE}/") or topic == "/diagnostics":
            assert who("publish", topic) == set(), topic


@pytest.fixture
def enforced(monkeypatch, tmp_path):
    """A keystore with an empty enclave of the node, which security is enforced with."""
    keystore = tmp_path / "keystore"
    (keystore / "enclaves" / "softtissue" / "node").mkdir(parents=True)
    for name, value in (("ENABLE", "true"), ("STRATEGY", "Enforce"), ("KEYSTORE", str(keystore))):
        monkeypatch.setenv(f"ROS_SECURITY_{name}", value)
    return keystore


@pytest.mark.parametrize("program", ["node", "score"])
@pytest.mark.parametrize("enclave", ["/softtissue/node", "/softtissue/nobody"])
def test_nothing_starts_unprotected_where_security_is_enforced(enforced, tmp_path, domain, enclave, program):
    """Of whichever kind the middleware is: it has no security, or finds no keys."""
    command = [executable(program), "--ros-args", "--enclave", enclave]
    with NodeProcess(domain, tmp_path, {}, program=command) as node:
        assert node.wait(60.0) == 2
        (line,) = [line for line in node.text.splitlines() if line.startswith("error: ")]
        assert "Traceback" not in node.text
    assert line.startswith("error: ROS 2 refuses: ")
    if enclave.endswith("nobody"):
        assert f"{enforced}/enclaves{enclave}' does not exist" in line


def test_same_program_runs_without_it(tmp_path, domain):
    assert "ROS_SECURITY_ENABLE" not in os.environ
    organ = write_organ(tmp_path / "organ")
    command = [executable("node"), "--ros-args", "--enclave", "/softtissue/node"]
    with NodeProcess(domain, tmp_path, {"organ": organ, "estimator": "elastic"}, program=command) as node:
        node.wait_for_text("answering clouds")
        assert node.stop() == 0
