"""Networks that others trained: VGG16, LPIPS over it, and how their weights are fetched."""
