"""What actions lead to.

::

    base.py       the contract, and what is observed
    model.py      the predictions of a forward model
    recalled.py   the same, and in their place what was really seen to follow, where that is known
    simulator.py  the true simulator, for the oracle
"""
