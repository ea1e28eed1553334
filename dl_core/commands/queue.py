"""`lightprobe queue WORKFLOW.api.json PHOTO...`: a workflow over photographs on running ComfyUI servers.

Only the options are here, so that help comes without loading torch.
"""

from __future__ import annotations

import argparse

__all__ = ["add_arguments", "run"]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `queue`."""
    add = parser.add_argument
    add("workflow", metavar="WORKFLOW.api.json", help="workflow in API form, such as those in workflows/")
    add("photos", metavar="PHOTO", nargs="+", help="photographs; each is a job of its own")
    add(
        "--server",
        metavar="URL",
        action="append",
        help="a running ComfyUI with this pack; give it again for more servers (default: http://127.0.0.1:8188)",
    )
    add("--out", metavar="DIR", default="probes", help="folder for the maps; what is there is kept (default: probes)")
    add("--seed", type=int, help="for every seed of the workflow (default: the workflow's)")
    add("--photo-node", metavar="ID", help="node that takes the photograph (default: the only Load Image node)")
    add("--timeout", type=float, default=300.0, help="seconds after which an absent server is given up (default: 300)")
    add(
        "--retries",
        type=int,
        default=2,
        help="times a job is queued again that a server lost while it ran, in a restart for one (default: 2)",
    )
    add("--json", action="store_true", help="print the report as JSON")


def run(args: argparse.Namespace) -> int:
    """Queue, follow, collect, report (see `queueing.run`)."""
    from .queueing import run as queue_and_collect

    return queue_and_collect(args)
