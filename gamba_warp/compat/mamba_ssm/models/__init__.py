"""Parts of mamba-ssm's language models, in files of its names."""
