"""Views against true ones: ``gamba eval-views``."""
