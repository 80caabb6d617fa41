"""What is done to sound files: to bytes, text and JSON, to containers, to the files themselves."""
