"""Camera paths: turntables, spirals, files of other programs; and movies along them."""
