"""Video through FFmpeg, by way of PyAV: the only place where video codecs are met.

``codecs`` are those that are written, ``writer`` writes a file, ``file`` opens one that somebody else has written, and
``stream`` turns the packets of a file or of a camera's topic into whole pictures. ``h264_numbers`` knows where
packets of a topic were lost.
"""
