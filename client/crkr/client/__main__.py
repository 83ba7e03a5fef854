"""`python -m crkr.client` is `crkr`."""

from crkr.client.cli.main import main

if __name__ == "__main__":
    main()
