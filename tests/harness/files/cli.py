"""Run ``tsgt`` inside the test's process, with its exit code."""

from __future__ import annotations

import io
import json
from contextlib import redirect_stderr, redirect_stdout
from typing import TYPE_CHECKING, Any, NamedTuple

import pytest

from tsgt.cli.main import cli, run

if TYPE_CHECKING:
    from collections.abc import Callable

    Tsgt = Callable[..., "Outcome"]


class Outcome(NamedTuple):
    """Exit code and output of a command."""

    code: int
    out: str
    err: str

    def json(self) -> Any:
        """Parse stdout as JSON."""
        return json.loads(self.out)


def called(*arguments: object) -> Outcome:
    """Run ``tsgt`` with the given arguments, without a fixture."""
    # Bytes below the text, as a terminal and a pipe have: what cannot be written in UTF-8 fails here, too.
    out, err = (io.TextIOWrapper(io.BytesIO(), encoding="utf-8", write_through=True) for _ in range(2))
    with redirect_stdout(out), redirect_stderr(err), pytest.raises(SystemExit) as ending:
        run(cli, [str(argument) for argument in arguments])
    assert isinstance(ending.value.code, int)
    said, complained = (stream.buffer.getvalue().decode() for stream in (out, err))
    return Outcome(ending.value.code, said, complained)


@pytest.fixture
def tsgt(capsys: pytest.CaptureFixture[str]) -> Tsgt:
    """Return a function that runs ``tsgt`` with the given arguments."""

    def call(*arguments: object) -> Outcome:
        capsys.readouterr()
        with pytest.raises(SystemExit) as ending:
            run(cli, [str(argument) for argument in arguments])
        printed = capsys.readouterr()
        assert isinstance(ending.value.code, int)
        return Outcome(ending.value.code, printed.out, printed.err)

    return call
