"""YAML that users write: plain values, and one sentence for whatever else a file holds."""

import os
import time

import pytest

from softtissue_estimator.errors import OrganError
from softtissue_estimator.support.yaml_file import MOST_BYTES, kind_of, read_yaml, shown


def read(tmp_path, content):
    path = tmp_path / "file.yaml"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return read_yaml(path, OrganError)


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        ("a: [1, 2.5, {b: c}]\nd: yes\n", {"a": [1, 2.5, {"b": "c"}], "d": True}),
        ("", None),
        ("\ufeffname: Größe\n", {"name": "Größe"}),
        ("name: Leber\n".encode("utf-16"), {"name": "Leber"}),
        ("a: 9223372036854775807", {"a": 2**63 - 1}),
    ],
)
def test_plain_values_are_read(tmp_path, content, expected):
    assert read(tmp_path, content) == expected


BOMB = "a: &a [x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"{name}: &{name} [{', '.join(9 * [f'*{before}'])}]\n"
    for before, name in zip("abcdefgh", "bcdefghi", strict=True)
)
MISTAKES = {
    "alias bomb": (BOMB, "alias"),
    "one alias": ("a: &x 1\nb: *x\n", "alias"),
    "brackets": (3000 * "[", "more than 16 levels"),
    "closed brackets": (3000 * "[" + 3000 * "]", "more than 16 levels"),
    "braces": (3000 * "{a: ", "more than 16 levels"),
    "dashes": (3000 * "- ", "more than 16 levels"),
    "impossible date": ("a: 2024-99-99\n", "cannot be read"),
    "400 digits": (f"a: {400 * '9'}\n", "cannot be read"),
    "4000 digits": (f"a: {4000 * '9'}\n", "cannot be read"),
    "5000 digits": (f"a: {5000 * '9'}\n", "4096 characters"),
    "hexadecimal": (f"a: 0x{400 * 'f'}\n", "cannot be read"),
    "to base 60": (f"a: 1{100_000 * ':59'}\n", "4096 characters"),
    "negative": (f"a: -{2**64}\n", "cannot be read"),
    "key twice": ("a: 1\na: 2\n", "line 2: a key that is there twice"),
    "key twice below": ("a: {b: 1, b: 1}\n", "twice"),
    "key that is a list": ("? [a]\n: b\n", "cannot be read"),
    "merge": ("<<: {a: 1}\n", "mistake"),
    "code": ("a: !!python/object/apply:os.getcwd []\n", "mistake"),
    "tag": ("a: !secret word\n", "mistake"),
    "two documents": ("a: 1\n---\nb: 2\n", "mistake"),
    "control character": ("a: \x01\n", "cannot be read"),
    "zero bytes": ("\0\0\0\0", "cannot be read"),
    "no text": (b"\xff\xfe\xff\xff\x00", "expected YAML"),
    "not utf-8": (b"name: secret \xe9\n", "expected YAML"),
    "too large": (b"# " + b"x" * MOST_BYTES, f"more than {MOST_BYTES} bytes"),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_whatever_else_is_one_sentence_at_once(tmp_path, name):
    content, words = MISTAKES[name]
    began = time.monotonic()
    with pytest.raises(OrganError, match=words) as caught:
        read(tmp_path, content)
    assert time.monotonic() - began < 2.0
    said = str(caught.value)
    assert "expected YAML" in said and "\n" not in said
    assert "secret" not in said


@pytest.mark.parametrize(
    "text",
    ["root:secret:0:0:/root:/bin/sh\nuser: secret: 1\n", "secret\n\tsecret: [", "a: 'secret", "%secret\n--"],
)
def test_sentence_tells_nothing_of_a_foreign_file(tmp_path, text):
    with pytest.raises(OrganError) as caught:
        read(tmp_path, text)
    assert "secret" not in str(caught.value)


def test_pipes_devices_and_folders_are_no_files(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path / "pipe", tmp_path, "/dev/zero", tmp_path / "none", tmp_path / ("x" * 300), "a\0b"):
        with pytest.raises(OrganError, match="expected YAML, got no file"):
            read_yaml(type(tmp_path)(path), OrganError)


def test_values_are_shown_shortened_or_by_kind():
    assert len(shown({"a": 10**6 * "x", "b": list(range(10**5))})) < 200
    assert shown("cm") == "'cm'"
    assert [kind_of(v) for v in (None, {}, [1, 2], "secret", 3)] == [
        "nothing",
        "a mapping",
        "a list of 2",
        "text",
        "a value of type int",
    ]
