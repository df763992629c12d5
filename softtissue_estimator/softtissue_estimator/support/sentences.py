"""One sentence of what came from outside: no line breaks, no control characters, of limited length."""

LONGEST = 300
_HEAD_SHARE = 0.6


def one_sentence(text: str, longest: int = LONGEST) -> str:
    r"""Return a text as one line that every log, message and terminal can hold.

    Line breaks become spaces; whatever else cannot be printed is escaped (control characters, lone surrogates, marks
    that turn the direction of writing). What is too long loses its middle.

    Examples
    --------
    >>> one_sentence("organ 'a\x1b[2J':\nexpected more")
    "organ 'a\\x1b[2J': expected more"
    >>> one_sentence("expected a name, got " + 30 * "x", 30)
    'expected a name, … xxxxxxxxxxx'
    """
    if len(text) > 4 * longest:  # escaping a message of megabytes takes a while
        text = text[: 2 * longest] + text[-2 * longest :]
    line = " ".join(text.split())
    if not line.isprintable():
        line = "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in line)
    if len(line) <= longest:
        return line
    head = int(_HEAD_SHARE * longest) - 2
    return f"{line[:head].rstrip()} … {line[head + 3 - longest :].lstrip()}"
