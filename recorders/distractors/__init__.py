"""Video that lies: what moves in the picture although nothing that matters does.

An environment draws agent and objects; ``Video`` turns what it drew into what a frame shows. In this order:

1. ``shake``: the camera moves, and with it everything. What comes in at the edge is the world's surroundings.
2. ``background``: moving textures, or the user's clips, over whatever is neither agent nor object.
3. ``movers`` and ``correlated``: things that move by themselves, before the background and behind agent and objects.
4. ``delay``: a frame shows an earlier moment.
5. ``noise``: of the sensor.

Each factor has a random stream of its own, made of the episode's entropy and the factor's name, so that one factor
changes nothing of another. No factor changes where anything is: the same seed and actions give the same states.

One factor is one file. ``scenes.py`` says how strong they may be and names the ready scenes; ``video.py`` puts them
together. None of them knows a world.
"""

from recorders.distractors.scenes import FACTORS, SCENES, Scene, SceneName, episode_values, make_scene, without_paths
from recorders.distractors.video import Picture, Video, VideoState, make_video

__all__ = [
    "FACTORS",
    "SCENES",
    "Picture",
    "Scene",
    "SceneName",
    "Video",
    "VideoState",
    "episode_values",
    "make_scene",
    "make_video",
    "without_paths",
]
