"""Pretrained networks: VGG16 and LPIPS, and the fetching of their weights."""
