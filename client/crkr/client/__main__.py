"""`python -m crkr.client` is `crkr`."""

from crkr.client.main import main

if __name__ == "__main__":
    main()
