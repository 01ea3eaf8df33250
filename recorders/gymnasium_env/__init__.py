"""The family ``gym``: any Gymnasium environment that draws pictures, by its id, as in ``gym:Pendulum-v1``.

::

    family.py             from an id to a class: finds the package, the id and its parameters
    environment.py        what a class does: frames, actions, and what may go wrong in somebody else's simulator
    guest.py              packages of others, without warnings and without a screen
    legacy_randomness.py  the process's shared random numbers, kept apart for a simulator that draws from them
    modules.py            which modules an id may have imported
    resets.py             whether a simulator begins a new episode by itself
    spaces.py             action spaces as ``ActionSpec``
    worlds.py             the ids that are known to work, and the packages that others come from
"""
