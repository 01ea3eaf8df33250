"""What actions lead to.

::

    base.py       the contract, and what is observed
    model.py      the predictions of a forward model
    simulator.py  the true simulator, for the oracle
"""
