"""What generation needs, in files of mamba-ssm's names."""
