"""The use-cases behind the commands, as functions: what ``import dmotion_bench as dm`` offers.

::

    contract.py       what somebody's own model breaks of its contract, before its training and where one fails
    datasets.py       open_dataset; a data set whose triplets torch can load
    demonstration.py  demo: everything once, small
    driving.py        a model that somebody drives, action by action
    importing.py      import_recordings; export_dataset: data sets from and for other tools
    installed.py      what the installed models are, and how this machine computes
    leaderboard.py    leaderboard_build, leaderboard_check, leaderboard_compare: the page, its entries, two runs
    planning.py       plan: one control task
    progress.py       how a caller is told how far the work is
    recording.py      record
    reproducing.py    reproduce: a whole table of figures
    runs.py           load_run; a trained model that takes frames and the names of actions
    scoring.py        score; references of control
    settings.py       settings as Python writes them
    sharing.py        share_push, share_pull, share_list: runs and data sets published by their hashes
    side_by_side.py   many trainings or scorings, in turn or several at a time
    table_work.py     the parts of a whole table, from recordings to pages
    training.py       train: new, resumed, taken over from another label budget, or anew where the weights are damaged
    viewing.py        view: what there is to see of a data set, a run, a report or several runs

A command parses what was typed, calls these, and prints what they return. They print nothing.
"""
