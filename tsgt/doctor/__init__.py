"""Whether a machine is ready for the field: one check per thing that keeps a client or a master from working.

Each check returns findings: one line that says in plain words what is wrong and what to type. What is outside (devices,
commands, users, the radio's bus) is handed in as a :class:`~tsgt.doctor.machine.Machine`.
"""
