"""The subcommands of ``hvt-study``, one module each, with `add_arguments` and `run`."""
