"""What a training computes on.

::

    devices.py       the CPU, a GPU, or several processes
    fabric_setup.py  a model and its optimiser on Fabric's device
    threads.py       how many threads compute
    precision.py     bf16 or float32
    timing.py        which of a few ways is faster here
    memory.py        how the C library treats memory that is freed
"""
