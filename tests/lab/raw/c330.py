"""Pictures as a Kodak C330 wrote them: rows of Y Cb Y Cr, 8 bits each, without a header; the longer files have gaps."""

from __future__ import annotations

import numpy as np

ROWS, COLUMNS = 912, 1232  # the last 16 columns are a margin
LENGTHS = (2247168, 3370752)
GAP_AFTER, GAP = 32, 39424  # rows and bytes, in the longer file


def c330(luma, blue, red, length=LENGTHS[0]):
    """Return a file of luma (912, 1232) and chroma (912, 616), whole numbers."""
    rows = np.empty((ROWS, COLUMNS, 2), np.uint8)
    rows[..., 0] = luma
    rows[:, ::2, 1], rows[:, 1::2, 1] = blue, red
    parts = [rows.tobytes()]
    if length == LENGTHS[1]:
        parts = [rows[top : top + GAP_AFTER].tobytes() + bytes(GAP) for top in range(0, ROWS, GAP_AFTER)]
    return b"".join(parts)[:length].ljust(length, b"\0")


def ramp(length=LENGTHS[0]):
    """Return a file of grey that grows from left to right, above a red and a blue stripe."""
    luma = np.broadcast_to(20 + 200 * np.arange(COLUMNS) // COLUMNS, (ROWS, COLUMNS)).copy()
    blue, red = np.full((2, ROWS, COLUMNS // 2), 128)
    luma[600:] = 100
    red[600:750], blue[750:] = 160, 160
    return c330(luma, blue, red, length)
