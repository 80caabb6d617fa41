"""How the page looks: calm, by the system's own fonts, light or dark as the system is."""

from __future__ import annotations

from pathlib import Path

from gradio import themes

LOOK = Path(__file__).parent / "look.css"


def theme() -> themes.Base:
    """Colours, corners and fonts; fonts by their names in the system, so that none is fetched."""
    return themes.Base(
        primary_hue=themes.colors.blue,
        neutral_hue=themes.colors.gray,
        radius_size=themes.sizes.radius_lg,
        font=["system-ui", "sans-serif"],
        font_mono=["ui-monospace", "monospace"],
    ).set(
        body_background_fill="#fbfbfa",
        body_background_fill_dark="#111316",
        body_text_color_subdued="#5d636d",
        body_text_color_subdued_dark="#a2a8b2",
        block_background_fill="#ffffff",
        block_background_fill_dark="#1a1d21",
        block_border_width="1px",
        block_label_background_fill="transparent",
        block_label_background_fill_dark="transparent",
        button_primary_background_fill="#1a63d8",
        button_primary_background_fill_hover="#1553b8",
        button_primary_background_fill_dark="#2563eb",
        button_primary_background_fill_hover_dark="#3b76f0",
        button_primary_text_color="#ffffff",
        button_secondary_background_fill="#ecedef",
        button_secondary_background_fill_hover="#e0e2e5",
        button_secondary_background_fill_dark="#2b2f36",
        button_secondary_background_fill_hover_dark="#383d46",
        button_secondary_text_color_dark="#e8e9eb",
    )
