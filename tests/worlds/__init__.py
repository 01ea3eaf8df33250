"""The figures and pictures of ``docs/worlds.md``: measured by ``measure.py``, written into the page by ``page.py``.

::

    python tests/worlds/measure.py gym:Pendulum-v1 --into docs/worlds.json --pictures docs/images/worlds
    python -m tests.worlds.page

The first is run in an environment where dmbench was installed with the world's extra, as a reader installs it; so it
imports nothing of the tests.
"""
