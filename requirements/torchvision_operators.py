"""Lets torchvision's wheel, which is built for CUDA, be imported beside a CPU torch.

Its import describes two operators that its library would define; they are defined, without a body, just before. A `.pth`
file imports this at every start of Python, so it waits for torchvision to be asked for.
"""

import sys
from importlib.abc import MetaPathFinder
from typing import Any


class _Operators(MetaPathFinder):
    def find_spec(self, fullname: str, *_: Any) -> None:
        if fullname != "torchvision":
            return
        sys.meta_path.remove(self)
        import torch

        if torch.version.cuda is None:
            # Definitions last as long as the library that holds them.
            self.library = torch.library.Library("torchvision", "DEF")
            for name in ("nms", "qnms"):
                self.library.define(f"{name}(Tensor dets, Tensor scores, float iou_threshold) -> Tensor")


HOOK = _Operators()
sys.meta_path.insert(0, HOOK)
