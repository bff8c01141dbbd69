"""Commands that run simulated missions: ``simulate`` in virtual time, ``demo`` with real processes in real time.

In come a scenario and options, made from the configuration models that they fill; out go recordings, the truth and
figures: ``figures`` of delivery and timing, ``poses`` of accuracy.
"""
