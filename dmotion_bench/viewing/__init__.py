"""Data sets, runs and reports in Rerun.

::

    target.py      what a path is: a data set, a run or a report
    scene.py       a scene: what is logged and how it is laid out, and writing it as one .rrd
    tracks.py      arrays -> Rerun's columns on the timeline ``frame``
    labels.py      what the labels of an episode look like
    eye.py         from where the world is looked at
    dataset.py     the scene of a data set
    imagination.py what a model makes of an episode, as arrays
    maps.py        the feature maps of a model, as pictures
    curves.py      the curves of a training, drawn by chart.py
    episodes.py    which episodes are shown
    report.py      the figures of a run, and its worst and best episodes
    run.py         the scene of a run; comparison.py: of several, side by side
    control.py     a control task, watched live; drive.py: an imagination that somebody drives
    live.py        recordings that are watched while they are made
    file_server.py one file over HTTP, for the web page
    viewer.py      Rerun's programs: a window, a web page, a headless one; guard.py ends them with this process
    screenshot.py  an .rrd -> a picture

Rerun is imported by these modules alone, and they only by the command that needs them.
"""
