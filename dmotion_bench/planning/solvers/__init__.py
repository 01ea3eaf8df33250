"""The search for actions.

::

    base.py        the contract: what a solver is given, and the plan it returns
    cem.py         the paper's cross-entropy method
    icem.py        iCEM, which repeats actions and keeps elites
    exhaustive.py  every sequence there is
"""
