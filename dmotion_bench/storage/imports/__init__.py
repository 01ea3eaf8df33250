"""Recordings of other systems: MCAP with foxglove or ROS 2 cameras, LeRobot data sets, read into ``dmbench/1``.

``mcap_records`` reads files it does not trust, ``cameras`` and ``commands`` decode their messages, ``pixels``
and ``fitting`` make frames, ``timeline`` resamples, ``mcap_recording`` and ``lerobot_recording`` answer the
same questions for their kinds of file, and ``importing`` writes the data set.
"""
