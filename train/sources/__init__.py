"""Published datasets: GSO; and shards of views."""
