"""Stand-in for torchvision where it is not installed, for this process and those that find this folder on PYTHONPATH.

ComfyUI imports torchvision at module level in model families these tests do not use, so empty modules will do. Others
ask `importlib.util.find_spec` whether it is there and would then want its contents: they are told that it is not.
"""

import importlib.util
import sys
import types

if importlib.util.find_spec("torchvision") is None:
    torchvision = types.ModuleType("torchvision")
    sys.modules["torchvision"] = torchvision
    for name in ("models", "transforms"):
        module = types.ModuleType(f"torchvision.{name}")
        setattr(torchvision, name, module)
        sys.modules[module.__name__] = module

    find_spec = importlib.util.find_spec

    def _without_torchvision(name, package=None):
        return None if name.partition(".")[0] == "torchvision" else find_spec(name, package)

    importlib.util.find_spec = _without_torchvision
