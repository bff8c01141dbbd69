"""Post-processing of recordings: poses, evaluation, reports, calibration, merging and file formats.

Comes in: a recording, station journals, files of other programs. Goes out: poses, statistics, set-up files, reports.
Rooms: calibration, design, evaluation, figures, formats, gnss, merge, report. ``processing`` and ``smoothing`` compute
poses with the estimators ``linear`` and ``continuous``; ``validation`` rejects unusable recordings with a reason.
"""
