"""The task log on PostgreSQL, which a second server can take over."""
