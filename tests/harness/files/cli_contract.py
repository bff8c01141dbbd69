"""What every command guarantees for any input file: a result or a one-line error, and no file but its output."""

from __future__ import annotations

import re
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Self

from harness.files.cli import Outcome, called

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

MAX_ERROR_CHARACTERS = 1000
"""Limit of an error message; file content is quoted in part only."""


class Files:
    """Input files in a temporary folder that is deleted on exit."""

    def __init__(self, contents: Mapping[str, bytes]) -> None:
        self._folder = tempfile.TemporaryDirectory()
        self.folder = Path(self._folder.name)
        self.contents = {self.folder / name: content for name, content in contents.items()}

    def __enter__(self) -> Self:
        for path, content in self.contents.items():
            path.write_bytes(content)
            path.chmod(0o600)
        return self

    def __exit__(self, *_: object) -> None:
        self._folder.cleanup()


def check_command(
    files: Files, arguments: Sequence[str], *, output: str = "", extra: Sequence[str] = ()
) -> Outcome:
    """Run a command; check its exit code, its error message and the files it leaves.

    Parameters
    ----------
    arguments, extra
        Arguments of ``tsgt``; those that begin with ``@`` are paths in the folder.
    output
        Name of the output file or folder, passed with ``--output`` unless it is among the arguments; empty: none.
    """
    given = [str(files.folder / each[1:]) if each.startswith("@") else each for each in arguments]
    if output and f"@{output}" not in arguments:
        given += ["--output", str(files.folder / output)]
    outcome = called(*given, *extra)
    assert outcome.code in (0, 1, 2, 3), outcome
    assert "Traceback" not in outcome.err
    if outcome.code in (1, 2):
        assert outcome.out == "", outcome
        # Warnings may precede it.
        *_, last = outcome.err.splitlines()
        assert re.match(r"[Ee]rror: \S", last), outcome.err
        assert last.isprintable(), outcome
        assert len(last) < MAX_ERROR_CHARACTERS + len(str(files.folder)), outcome.err
        errors = len(re.findall("^[Ee]rror: ", outcome.err, re.MULTILINE))
        assert errors == 1 or arguments[:2] == ("config", "check"), (
            outcome
        )  # which reports all errors at once
    left = set(files.folder.iterdir()) - set(files.contents)
    written = {files.folder / output} if output and outcome.code in (0, 3) else set()
    assert left <= written, outcome
    assert outcome.code != 0 or left == written, outcome
    for path, content in files.contents.items():
        assert path.read_bytes() == content, path
    return outcome
