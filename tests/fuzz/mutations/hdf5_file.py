"""HDF5: data sets of other shapes, types and filters, links that lead elsewhere, attributes; or the file's bytes."""

from __future__ import annotations

import io

import h5py
import numpy as np

from tests.fuzz.mutations import pick
from tests.fuzz.mutations.json_text import spoil_json
from tests.fuzz.mutations.plain import spoil_bytes

HUGE = ((2**40, 16, 16, 3), (2**31, 16, 16, 3), (10**6, 16, 16, 3), (3, 2**20, 2**20, 3), (2**62,), (4, 16, 16, 2**30))

FILTERS = ({"compression": "gzip"}, {"compression": "lzf"}, {"fletcher32": True}, {"shuffle": True}, {"scaleoffset": 4})


def spoil_hdf5(rng: np.random.Generator, data: bytes) -> tuple[bytes, str]:
    """One or two changes of what the file holds, or of its bytes."""
    if rng.random() < 0.35:
        return spoil_bytes(rng, data)
    buffer, told = io.BytesIO(data), []
    try:
        with h5py.File(buffer, "r+") as file:
            told += [_change(rng, file) for _ in range(int(rng.choice([1, 1, 2])))]
    except (OSError, KeyError, ValueError, RuntimeError, TypeError):
        return spoil_bytes(rng, data)
    return buffer.getvalue(), f"hdf5: {'; '.join(told)}"


def _change(rng: np.random.Generator, file: h5py.File) -> str:
    names: list[str] = []
    file.visit(names.append)
    name = pick(rng, names)
    kind = pick(rng, ("shape", "type", "link", "gone", "attribute", "rows", "filter", "group", "values", "name"))
    old = file[name]
    whole = isinstance(old, h5py.Dataset)
    if kind == "attribute":
        holder = pick(rng, (file["data"], old))
        key = pick(rng, ["num_samples", "total", "env_args", "new", *holder.attrs])
        value = holder.attrs.get(key)
        if isinstance(value, str):
            holder.attrs[key] = spoil_json(rng, value.encode())[0].decode("utf-8", "replace")[:60_000]
        else:
            holder.attrs[key] = pick(
                rng, (0, -1, 2**62, 1.5, np.nan, "text", b"\xff", np.zeros(50), np.array(["a", "b"], "S"))
            )
        return f"{name}: attribute {key}"
    if kind == "gone":
        del file[name]
    elif kind == "name":
        file.move(name, pick(rng, (f"{name}x", "data/é", "data/demo_999999999999999999999", f"{name}/deeper")))
    elif kind == "link":
        del file[name]
        file[name] = pick(
            rng,
            (
                h5py.SoftLink("/nowhere"),
                h5py.SoftLink(f"/{name}"),
                h5py.SoftLink("/data"),
                h5py.SoftLink("/"),
                h5py.ExternalLink("/etc/passwd", "/"),
                h5py.ExternalLink("other.hdf5", "/data"),
            ),
        )
    elif kind == "group":
        del file[name]
        file.create_group(name)
    elif not whole:
        del file[name]
        file.create_dataset(name, data=np.zeros((5, 16, 16, 3), np.uint8))
    else:
        _change_dataset(rng, file, name, old[()], kind)
    return f"{name}: {kind}"


def _change_dataset(rng: np.random.Generator, file: h5py.File, name: str, values: np.ndarray, kind: str) -> None:
    del file[name]
    if kind == "shape":
        if rng.random() < 0.5:
            shape = pick(rng, HUGE)
            file.create_dataset(name, shape=shape, dtype="u1", chunks=tuple(min(one, 16) for one in shape))
        else:
            file.create_dataset(
                name, data=pick(rng, (values[..., None], values[..., 0], values[0], values[:0], values.T))
            )
    elif kind == "type":
        other = pick(rng, ("f4", "i8", "f8", "S5", "bool", "c8", [("a", "u1"), ("b", "f4")]))
        if isinstance(other, list):
            file.create_dataset(name, shape=values.shape, dtype=other)
        elif rng.random() < 0.3:
            file.create_dataset(name, shape=values.shape[:1], dtype=h5py.string_dtype())
        else:
            file.create_dataset(name, data=values.astype(other))
    elif kind == "rows":
        file.create_dataset(name, data=pick(rng, (values[:1], values[:2], values[:-1], np.concatenate([values] * 40))))
    elif kind == "filter":
        how = pick(
            rng,
            (
                {"compression": "gzip"},
                {"compression": "lzf"},
                {"fletcher32": True},
                {"shuffle": True},
                {"scaleoffset": 4},
            ),
        )
        file.create_dataset(name, data=values.astype("i4") if "scaleoffset" in how else values, chunks=True, **how)
    else:
        filled = {"f": np.nan, "u": 255, "i": -(2**31)}.get(values.dtype.kind, 0)
        file.create_dataset(name, data=np.full(values.shape, filled, values.dtype))
