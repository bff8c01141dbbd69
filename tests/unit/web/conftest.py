"""Fixtures of the page's tests."""

from __future__ import annotations

import pytest

from tsgt.web import access


@pytest.fixture(autouse=True, scope="session")
def _quick_keys() -> None:
    """Derive the key of the cookies quickly: being slow on purpose is no use here."""
    access.KEY_ITERATIONS = 10
