"""The client's subcommands of `crkr`; the other parts bring their own."""
