"""Language models of mamba-ssm, in files of its names."""
