"""The report's page with untrusted text."""

from __future__ import annotations

from tsgt.analysis.report import render_page
from tsgt.analysis.report.page import Section, Table
from tsgt.analysis.report.verdicts import Level, Verdict


def test_text_is_escaped() -> None:
    """Names of files, sources and events are shown literally; none becomes a tag or ends an attribute."""
    evil = "<script>alert(1)</script>\"'><img src=x onerror=alert(1)>`<b>`"
    table = Table(caption=evil, header=(evil, evil), rows=((evil, evil),))
    text = render_page(
        evil,
        table,
        [Verdict(Level.BAD, evil)],
        [Section(title=evil, text=(evil,), tables=(table,))],
        {},
    )
    assert "&lt;script&gt;" in text
    for tag in ("<script", "<img", "<b>"):
        assert tag not in text
