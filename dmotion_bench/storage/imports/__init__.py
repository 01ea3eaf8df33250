"""Recordings of other systems, read into ``dmbench/1``: MCAP, videos, folders of pictures, HDF5, LeRobot data sets.

``search`` finds the recordings that are meant, ``passed_over`` what lies beside them, ``sources`` tells their kinds.
Each kind has a file that answers the questions of ``recording``: ``mcap_recording``, ``mcap_video``,
``video_recording``, ``picture_folder``, ``hdf5_recording``, ``lerobot_recording``.
What libraries of C read is read in a process apart: ``confinement`` is this end of it, ``confined_reader`` the other,
and ``wire`` what they say to each other. ``git_lfs`` knows files that were not fetched, and ``episode_faults`` leaves
out damaged episodes of a recording that holds several.

``mcap_records`` reads MCAP files without trust, ``hdf5_contents`` and ``hdf5_pictures`` HDF5; ``cameras`` and
``commands`` decode their messages, ``pixels`` and ``fitting`` make frames, ``timeline`` resamples. ``import_plan``
says which data set the recordings become, with ``source_rate`` how fast they are, ``overlaps`` which were made at one
time and ``advice`` what would make a better one; ``importing`` writes it.
"""
