"""Every error's text is one line that can be printed, whatever a file or a message holds."""

import pytest

from softtissue_estimator.errors import InvalidInputError, MeshError, MissingDependencyError


@pytest.mark.parametrize("kind", [InvalidInputError, MeshError, MissingDependencyError])
def test_text_is_one_printable_line_of_limited_length(kind):
    said = f"mesh a.obj: expected a number, got 'x\n\x1b[2J{5000 * 'y'}' in line 7"
    text = str(kind(said))
    assert text.startswith("mesh a.obj: expected a number, got 'x \\x1b[2J") and text.endswith("' in line 7")
    assert text.isprintable() and len(text) == 300
    assert kind(said).args == (said,)
    assert str(kind("expected a file, found none")) == "expected a file, found none"
