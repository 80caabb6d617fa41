"""What strangers' files go through before anything of ours believes them; see docs/security.md."""
