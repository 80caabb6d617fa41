"""Published datasets: G-Objaverse, Objaverse, GSO; and shards of views."""
