"""What the tests of simulating commands share."""

from __future__ import annotations

import tempfile
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from collections.abc import Iterator


@pytest.fixture
def short_temporary_folder(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Let commands make their folders below one whose path is short enough for sockets, and remove it."""
    with tempfile.TemporaryDirectory(prefix="t-") as path:
        monkeypatch.setattr("tempfile.tempdir", path)
        yield
