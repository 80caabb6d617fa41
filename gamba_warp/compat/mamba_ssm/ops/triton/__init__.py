"""The path under which mamba-ssm has the update of a state; there is no Triton here."""
