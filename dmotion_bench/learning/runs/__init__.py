"""A run on disk, from its request to its trained model.

::

    start.py          a user's request becomes a run
    own_data.py       the data set of a run, by its path or its fingerprint
    run.py            the run's folder: its request, its progress and its trained model
    manifest.py       ``run.json``
    checkpoint.py     weights and facts in one safetensors file
    source.py         the code of a model, hashed
    syntax_hash.py    the hash of what Python source means
    defined_class.py  the hash of classes that have no file
"""
