"""The type checker behind the shape annotations: an int may stand where a float is asked for, as in PEP 484."""

from __future__ import annotations

import beartype as _beartype

beartype = _beartype.beartype(conf=_beartype.BeartypeConf(is_pep484_tower=True))
