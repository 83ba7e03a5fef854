"""Every reported trial, in columns."""
