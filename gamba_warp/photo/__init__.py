"""From any photograph to a cut-out object: mattes, masks, formats of cameras."""
