"""Damage as crashes, disks and copies cause it."""


def damaged_bytes(rng, raw, length):
    """Damage about ``length`` bytes in one of several ways; None stands for a lost file."""
    raw = bytearray(raw)
    at = rng.randrange(len(raw) + 1)
    kind = rng.randrange(7)
    if kind == 0:  # some bytes
        for _ in range(rng.randint(1, 20) if raw else 0):  # a part may have no byte yet
            raw[rng.randrange(len(raw))] = rng.randrange(256)
    elif kind == 1:  # noise, zeros or ones
        noise = rng.choice([rng.randbytes(length), bytes(length), b"\xff" * length])
        raw[at : at + length] = noise[: len(raw) - at]
    elif kind == 2:
        del raw[at:]
    elif kind == 3:  # bytes lost or doubled: all behind them moves
        raw[at : at + length] = rng.choice([b"", 2 * raw[at : at + length]])
    elif kind == 4:  # one block in the place of another
        start = rng.randrange(len(raw) + 1)
        raw[at : at + length] = raw[start : start + length]
    elif kind == 5:
        raw[at:at] = rng.randbytes(length)
    else:
        return None
    return raw
