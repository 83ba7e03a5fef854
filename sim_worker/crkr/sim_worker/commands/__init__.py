"""The subcommands of `crkr` that this part provides; each module is imported only when its command runs."""
