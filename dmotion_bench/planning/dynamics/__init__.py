"""What actions lead to.

::

    base.py         the contract, and what is observed
    model.py        the predictions of a forward model
    simulator.py    the true simulator, for the oracle
    rollouts.py     predictions of sequences of continuous actions
    prefix_tree.py  predictions of many action sequences; a beginning that several share is predicted once
"""
