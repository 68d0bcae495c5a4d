# SPDX-License-Identifier: MIT
import os

# Huge pages, which torch requests only if this is set before its first allocation: the page faults of large
# arrays take a fifth of the time of prediction on a processor.
os.environ.setdefault("THP_MEM_ALLOC_ENABLE", "1")
