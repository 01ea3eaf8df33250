"""Planning with a forward model, and control with a planner.

::

    mpc.py         the control loop: observe, plan, act; many tasks at once, resumable
    agents.py      who chooses the actions: a model with a solver and an objective, idle, random, the oracle, a script
    tasks.py       stored tasks as problems: start state by replay, goal image, judged distance
    experience.py  what was seen to follow what in a task
    moments.py     where something can be gained, and what each of some fixed action sequences truly brings there
    journal.py     the progress of control, on disk
    choices.py     solvers and objectives by their names, with every field settable, and as a report holds them
    contract.py    what a solver or an objective breaks of its contract, in a sentence
    columns.py     the frozen planners and the test tasks of the table of control
    dynamics/      what actions lead to: a forward model, the true simulator
    objectives/    what is minimised: centres, pixels, features; for arms that push objects on a table, tabletop/
    solvers/       the search: the cross-entropy method, iCEM, random shooting, MPPI, gradients, every sequence

``base.py`` in each folder is its contract. Solvers may import objectives, objectives dynamics.
Solvers and objectives are reached through the entry points
``dmbench.solvers`` and ``dmbench.objectives`` (``docs/your_planner.md``).
"""
