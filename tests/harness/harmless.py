"""What every command owes to a file from outside: a result, or one line of error; and no other file than its result."""

from __future__ import annotations

import re
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Self

from harness.cli import Outcome, called

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

LONGEST_ERROR = 1000
"""Characters; what a file says is quoted, but not all of it."""


class Files:
    """Files of a folder of their own, by their names; it ends with the block."""

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


def check(files: Files, arguments: Sequence[str], *, output: str = "", extra: Sequence[str] = ()) -> Outcome:
    """Run a command; check how it ends, and what it leaves behind.

    Parameters
    ----------
    files
        What it reads.
    arguments, extra
        Of ``tsgt``; one that begins with ``@`` is a path in the folder.
    output
        Name of the file or folder that it writes, with ``--output`` unless the arguments hold it; empty: none.
    """
    given = [str(files.folder / each[1:]) if each.startswith("@") else each for each in arguments]
    if output and f"@{output}" not in arguments:
        given += ["--output", str(files.folder / output)]
    outcome = called(*given, *extra)
    assert outcome.code in (0, 1, 2, 3), outcome
    assert "Traceback" not in outcome.err
    if outcome.code in (1, 2):
        assert outcome.out == "", outcome
        # What was skipped, or is doubtful, may stand before it.
        *_, last = outcome.err.splitlines()
        assert re.match(r"[Ee]rror: \S", last), outcome.err
        assert last.isprintable(), outcome
        assert len(last) < LONGEST_ERROR + len(str(files.folder)), outcome.err
        assert len(re.findall("^[Ee]rror: ", outcome.err, re.MULTILINE)) == 1
    left = set(files.folder.iterdir()) - set(files.contents)
    written = {files.folder / output} if output and outcome.code in (0, 3) else set()
    assert left <= written, outcome
    assert outcome.code != 0 or left == written, outcome
    for path, content in files.contents.items():
        assert path.read_bytes() == content, path
    return outcome
