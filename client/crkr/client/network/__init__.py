"""Everything that imports Zenoh: sessions, queries, subscriptions and liveliness tokens."""
