# SPDX-License-Identifier: MIT
"""Replacement of ``model.reconstruction.unwrap.xatlas_process`` that places no triangle."""

from __future__ import annotations

import sys

import numpy as np

if __name__ == "__main__":
    with np.load(sys.argv[1]) as data:
        count = len(data["faces"])
    nowhere = np.full((count, 3, 2), np.nan)
    np.savez(sys.argv[2], corners=nowhere, size_m=np.full(2, np.nan), is_placed=np.zeros(count, bool))
