"""Parameters of generation, in files of mamba-ssm's names."""
