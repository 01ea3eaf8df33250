"""What a training learns from: triplets of frames, and the labels that its budget pays for.

::

    triplets.py               triplets of consecutive frames out of the frame cache, and the order of a training
    batches.py                batches on the device that trains or predicts
    streamed.py               the same, read from the compressed files while a model trains
    streamed_order.py         their order: shuffled within windows
    label_request.py          how many labels a run asks for, as it is written
    labels.py                 the label budget: the only door to ``labels/``, and the count
    stored_demonstrations.py  demonstrations that are too many for the memory
    curriculum.py             triplets and labels, phase by phase
"""
