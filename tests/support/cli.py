"""Calls ``tsgt`` inside the test's own process, exit code included."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any, NamedTuple

import pytest

from tsgt.cli.main import cli, run

if TYPE_CHECKING:
    from collections.abc import Callable

    Tsgt = Callable[..., "Outcome"]


class Outcome(NamedTuple):
    """What a command left behind."""

    code: int
    out: str
    err: str

    def json(self) -> Any:
        """Parse what it printed as JSON."""
        return json.loads(self.out)


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
