"""Image metrics of predicted views: ``gamba eval-views``."""
