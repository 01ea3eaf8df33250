"""Data sets, runs and reports in Rerun, and as pictures.

::

    target.py       what a path names: a data set, a run, a report or an .rrd
    episodes.py     which episodes are shown
    scene.py        a scene: what is logged and how it is laid out, written as one .rrd
    tracks.py       whole episodes as Rerun's columns on the timeline ``frame``
    labels.py       what the labels of an episode look like
    eye.py          the place from which the world is looked at
    dataset.py      the scene of a data set
    imagination.py  what a model predicts of an episode, as arrays
    maps.py         the feature maps of a model, as pictures
    run.py          the scene of a run
    comparison.py   the scene of several runs, side by side
    report.py       the figures of a run, and its worst and best episodes
    curves.py       the curves of a training
    chart.py        a chart with a logarithmic axis
    animation.py    a recorded and an imagined episode side by side, as GIF or WebP
    captions.py     frames in rows and columns with words, as one picture
    control.py      a control task, watched live
    filmstrip.py    a control task as one picture
    drive.py        a model's predictions while somebody drives them
    live.py         recordings that are watched while they are made
    follow.py       a training or a recording that is watched while it goes on
    page_server.py  Rerun's web page and the file that it shows, over HTTP
    viewer.py       Rerun's programs: a window, a web page, a headless one
    guard.py        ends Rerun's programs with the process that started them
    screenshot.py   an .rrd as a picture

Rerun is imported by these modules alone, and they are imported only by the commands that need them.
"""
