"""The sub-commands of `lightprobe`, one module each: `add_arguments(parser)` and `run(args)`."""
