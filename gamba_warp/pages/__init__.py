"""What people look at: turntables and HTML pages with a viewer."""
