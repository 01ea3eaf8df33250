"""dmbench installed from its wheel, without the source tree: built, installed, and used in an empty folder."""
