"""The sections of the report: text, tables and figures on one subject each.

In: ``Findings``. Out: ``Section`` objects for the page, in the order of `document`; `calibration`, `diagnosis` and `imu` also give the
numbers that the report has as JSON. Nothing is exported: `tsgt.analysis.report.numbers` takes from some sections, others take from it.
"""
