"""What one would use instead of crkr, each behind the same interface and on the same trials."""
