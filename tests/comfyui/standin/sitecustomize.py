"""Stand-in for torchvision where it is not installed, for this process and those that find this folder on PYTHONPATH.

ComfyUI imports torchvision at module level in model families these tests do not use, so empty modules will do. Others
ask `importlib.util.find_spec` whether it is there and would then want its contents: they are told that it is not.
spandrel, which cannot do without it, gets a stand-in too: ComfyUI's UpscaleModelLoader needs its names, and the web
client fails on every model loader where that node is missing.
"""

import importlib.util
import sys
import types


def _module(name, **contents):
    module = types.ModuleType(name)
    vars(module).update(contents)
    sys.modules[name] = module
    return module


if importlib.util.find_spec("torchvision") is None:
    _module("torchvision", models=_module("torchvision.models"), transforms=_module("torchvision.transforms"))
    _module("spandrel", ModelLoader=type("ModelLoader", (), {}), ImageModelDescriptor=type("Descriptor", (), {}))

    find_spec = importlib.util.find_spec

    def _without_torchvision(name, package=None):
        return None if name.partition(".")[0] == "torchvision" else find_spec(name, package)

    importlib.util.find_spec = _without_torchvision
