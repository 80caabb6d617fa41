"""Reports of shards, joined to one."""
