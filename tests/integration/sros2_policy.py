"""The shipped policy of SROS2: what it allows, and a keystore as `ros2 security` would make it of it."""

import subprocess
import xml.etree.ElementTree as ElementTree
from pathlib import Path

from softtissue_estimator.support.resources import resource

ENCLAVES = (
    "node",
    "tracker",
    "registration",
    "operator",
    "display",
    "overlay",
    "viewer",
    "igtl_bridge",
    "recorder",
)
# What a profile's parts may say, with the topics of DDS that this gives: (what is published, what is subscribed).
ACTS = {
    ("topics", "publish"): (["rt{}"], []),
    ("topics", "subscribe"): ([], ["rt{}"]),
    ("services", "request"): (["rq{}Request"], ["rr{}Reply"]),
    ("services", "reply"): (["rr{}Reply"], ["rq{}Request"]),
}
# SROS2's own: everybody has a key, and everything is encrypted.
GOVERNANCE = """<dds><domain_access_rules><domain_rule>
<domains><id>{domain}</id></domains>
<allow_unauthenticated_participants>false</allow_unauthenticated_participants>
<enable_join_access_control>true</enable_join_access_control>
<discovery_protection_kind>ENCRYPT</discovery_protection_kind>
<liveliness_protection_kind>ENCRYPT</liveliness_protection_kind>
<rtps_protection_kind>SIGN</rtps_protection_kind>
<topic_access_rules><topic_rule><topic_expression>*</topic_expression>
<enable_discovery_protection>true</enable_discovery_protection>
<enable_liveliness_protection>true</enable_liveliness_protection>
<enable_read_access_control>true</enable_read_access_control>
<enable_write_access_control>true</enable_write_access_control>
<metadata_protection_kind>ENCRYPT</metadata_protection_kind>
<data_protection_kind>ENCRYPT</data_protection_kind>
</topic_rule></topic_access_rules></domain_rule></domain_access_rules></dds>
"""
PERMISSIONS = """<dds><permissions><grant name="{enclave}"><subject_name>CN={enclave}</subject_name>
<validity><not_before>2020-01-01T00:00:00</not_before><not_after>2100-01-01T00:00:00</not_after></validity>
<allow_rule><domains><id>{domain}</id></domains>
<publish><topics>{publish}</topics></publish><subscribe><topics>{subscribe}</topics></subscribe></allow_rule>
<default>DENY</default></grant></permissions></dds>
"""


def policy() -> ElementTree.Element:
    return ElementTree.parse(resource("config", "security", "policy.xml")).getroot()


def allowed(enclave: str) -> dict[str, set[str]]:
    """Expressions of full names that the policy allows an enclave, by what it may do."""
    (profile,) = policy().findall(f"enclaves/enclave[@path='/softtissue/{enclave}']/profiles/profile")
    found: dict[str, set[str]] = {act: set() for _, act in ACTS}
    base = f"{profile.get('ns')}{profile.get('node')}"
    for part in profile:
        for act, rule in part.attrib.items():
            assert (part.tag, act) in ACTS and rule == "ALLOW"
            found[act] |= {name.text.replace("~", base) for name in part}
    return found


def dds_topics(enclave: str) -> dict[str, list[str]]:
    """The same as topics of DDS that it may publish and subscribe."""
    found = {"publish": ["ros_discovery_info"], "subscribe": ["ros_discovery_info"]}
    for (_, act), forms in ACTS.items():
        for name in allowed(enclave)[act]:
            for direction, patterns in zip(found, forms, strict=True):
                found[direction] += [pattern.format(name) for pattern in patterns]
    return {direction: sorted(set(topics)) for direction, topics in found.items()}


def write_keystore(folder: Path, domain: int) -> None:
    """Write the folders of all enclaves, each as SROS2 lays it out, signed by an authority of this moment."""

    def openssl(*arguments: str) -> None:
        subprocess.run(["openssl", *arguments], cwd=folder, check=True, capture_output=True)

    def key(name: str) -> None:
        openssl("ecparam", "-name", "prime256v1", "-genkey", "-noout", "-out", name)

    def sign(name: str, text: str) -> None:
        (folder / f"{name}.xml").write_text(text)
        signer = ("-signer", "ca.cert.pem", "-inkey", "ca.key.pem")
        openssl("smime", "-sign", "-text", "-in", f"{name}.xml", *signer, "-out", f"{name}.p7s")

    key("ca.key.pem")
    openssl(
        "req",
        "-x509",
        "-new",
        "-sha256",
        "-key",
        "ca.key.pem",
        "-subj",
        "/CN=test",
        "-days",
        "2",
        "-out",
        "ca.cert.pem",
    )
    sign("governance", GOVERNANCE.format(domain=domain))
    authority, governance = (folder / "ca.cert.pem").read_bytes(), (folder / "governance.p7s").read_bytes()
    for enclave in ENCLAVES:
        place = folder / enclave
        place.mkdir()
        path = f"/softtissue/{enclave}"
        lists = {
            direction: "".join(f"<topic>{topic}</topic>" for topic in topics)
            for direction, topics in dds_topics(enclave).items()
        }
        sign(f"{enclave}/permissions", PERMISSIONS.format(enclave=path, domain=domain, **lists))
        key(f"{enclave}/key.pem")
        name = "/CN=" + path.replace("/", r"\/")
        openssl(
            "req",
            "-new",
            "-sha256",
            "-key",
            f"{enclave}/key.pem",
            "-subj",
            name,
            "-out",
            f"{enclave}/request",
        )
        signer = ("-CA", "ca.cert.pem", "-CAkey", "ca.key.pem", "-CAcreateserial", "-days", "2")
        openssl(
            "x509", "-req", "-sha256", "-in", f"{enclave}/request", *signer, "-out", f"{enclave}/cert.pem"
        )
        (place / "identity_ca.cert.pem").write_bytes(authority)
        (place / "permissions_ca.cert.pem").write_bytes(authority)
        (place / "governance.p7s").write_bytes(governance)
