from helpers.raster_accuracy import cuts, one_thread

__all__ = ["cuts", "one_thread"]
