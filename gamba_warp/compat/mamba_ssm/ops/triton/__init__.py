"""mamba-ssm's path of the state update; it does not use Triton."""
