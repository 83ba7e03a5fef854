"""What each verb of the protocol does."""
