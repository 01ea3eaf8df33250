"""The search for actions.

::

    base.py             the contract: what a solver is given, and the plan it returns
    cem.py              the paper's cross-entropy method
    icem.py             iCEM, with coloured noise and kept elites
    random_shooting.py  the best of many sequences
    mppi.py             path integral control, for continuous actions
    gradient.py         gradient descent through a model, for continuous actions
    exhaustive.py       every sequence of discrete actions
    proposals.py        the distributions that sequences are drawn from
"""
