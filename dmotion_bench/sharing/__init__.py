"""Runs and data sets published under their hashes, so that others can fetch them and check results from files alone.

::

    place.py          a place to publish in: a folder, or object storage
    run_share.py      what is published of a run, and the manifest of it
    push.py           publish a run or a data set
    pull.py           fetch one, verified before it appears
    arriving.py       where files arrive before they are verified
    contents.py       what a place holds
    wanted.py         what an entry of the leaderboard needs

In a place::

    datasets/<fingerprint>/<name>/       a data set, which can be opened by this address
    runs/<weights>/<manifest>.json       what is published of a run; the file's name is its SHA-256
    runs/<weights>/files/<sha256>        its files, each under its own SHA-256

``dataset.json`` and a run's manifest are written last, so what was published by half is not there. Every name is a hash
of what stands under it: nothing is ever replaced by other content, and who fetches need not trust who stores.
"""
