"""The frame of the `crkr` command: subcommands, options, output and errors."""
