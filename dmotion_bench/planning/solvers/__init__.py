"""The search for actions.

::

    base.py             the contract: what a solver is given, and the plan it returns
    checked.py          a solver whose plans are checked as they are made
    cem.py              the paper's cross-entropy method
    icem.py             iCEM, with coloured noise and kept elites; also with what was seen in the task (icem-recall)
    graph.py            iCEM that searches for a way where no plan gains anything (icem-graph)
    random_shooting.py  the best of many sequences
    mppi.py             path integral control, for continuous actions
    gradient.py         gradient descent through a model, for continuous actions
    exhaustive.py       every sequence of discrete actions
    proposals.py        the distributions that sequences are drawn from
    search.py           what solvers share: sequences are predicted once, a plan is made of the cheapest
    prefix_tree.py      ... of discrete actions: a beginning that several sequences share is predicted once
    rollouts.py         ... of continuous actions
"""
