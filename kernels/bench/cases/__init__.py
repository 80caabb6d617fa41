"""What is measured, one subject a file: cases, problems and knobs of each operator."""
