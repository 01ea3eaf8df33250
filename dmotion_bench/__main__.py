"""``python -m dmotion_bench`` is the command ``dmbench``, of whichever Python runs it."""

from dmotion_bench.cli import main

if __name__ == "__main__":
    main()
