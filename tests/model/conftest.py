# SPDX-License-Identifier: MIT
"""Use one torch thread, since tests use tiny tensors and several test processes may share the cores."""

import torch

torch.set_num_threads(1)
