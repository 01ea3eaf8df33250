"""The family ``gym``: any Gymnasium environment that draws pictures, by its id, as in ``gym:Pendulum-v1``.

::

    family.py       from an id to a class: finds the package, the id and its parameters
    environment.py  what a class does: frames, actions, and what may go wrong in somebody else's simulator
    modules.py      which modules an id may have imported
    spaces.py       action spaces as ``ActionSpec``
    worlds.py       the ids that are known to work, and the packages that others come from
"""
