"""What the core logs is passed on as one printable line each."""

import logging

from softtissue_estimator.support.log_lines import log_lines

_log = logging.getLogger("softtissue_estimator.organ")


def test_lines_are_passed_on_while_the_block_runs_and_can_be_printed():
    lines = []
    with log_lines(lines.append):
        _log.info("mesh %s: read", "a.ply")
        _log.warning("mesh %s: closed", "b\n\x1b[2J.ply")
        _log.debug("mesh c.ply: details")
        _log.info("mesh %s: read", 5000 * "d")
    _log.warning("mesh e.ply: read")
    assert lines[:2] == ["mesh a.ply: read", "warning: mesh b \\x1b[2J.ply: closed"]
    assert len(lines) == 3 and len(lines[2]) == 300
