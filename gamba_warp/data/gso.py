"""Evaluation ``gso``: its 60 Google Scanned Objects, poses and image size.

The paper (§4.1) evaluates 60 objects of the set at 512² and does not name them. These 60 are
another choice, fixed by name: ten of each of six groups, chosen for variety by their names only,
before any of them was rendered or reconstructed here. The names are from the 1,030 models that the
set's owner GoogleResearch publishes on the Fuel server. The list never changes; with another one
(``--objects``) a report states so, with its SHA-256.
"""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Iterable, Sequence
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal

from ..conventions import DEFAULT_FOV
from ..errors import UserError
from ..untrusted.documents import read_bytes
from ..untrusted.names import plain_name

_MAX_LIST = 1 << 20  # bytes of a list of names

SIZE = 512  # pixels, §4.1: "at a spatial resolution of 512 × 512"
FOV = DEFAULT_FOV  # degrees; not stated, so the reference camera's
# The first view is the input: §4.1 "a default camera pose with both zero elevation and azimuth".
# Number and poses of the other views are not stated.
ELEVATIONS = (0.0, 20.0, 40.0)  # degrees
AZIMUTHS = tuple(45.0 * number for number in range(8))  # degrees; at 0 the camera stands at -y
VIEWS = len(ELEVATIONS) * len(AZIMUTHS)
UP: Literal["z"] = "z"  # of the set's files

GROUPS: dict[str, tuple[str, ...]] = {
    group: tuple(names.split())
    for group, names in {
        "animals and figures": """
            Android_Figure_Orange Breyer_Horse_Of_The_Year_2015 Great_Dinos_Triceratops_Toy Racoon
            Schleich_African_Black_Rhino Schleich_Lion_Action_Figure
            Schleich_Spinosaurus_Action_Figure Sootheze_Cold_Therapy_Elephant Squirrel
            Weisshai_Great_White_Shark
        """,
        "toys": """
            3D_Dollhouse_Sofa BALANCING_CACTUS BUNNY_RACER CASTLE_BLOCKS CHICKEN_NESTING
            SHAPE_SORTER SORTING_BUS STACKING_BEAR Sonny_School_Bus Vtech_Roll_Learn_Turtle
        """,
        "shoes, bags and hats": """
            11pro_SL_TRX_FG AMBERLIGHT_UP_W ASICS_GELAce_Pro_Pearl_WhitePink
            Azure_Snake_Tieks_Leather_Snake_Print_Ballet_Flats Big_Dot_Pink_Pencil_Case
            DPC_Handmade_Hat_Brown Jansport_School_Backpack_Blue_Streak
            Olive_Kids_Paisley_Pencil_Case REEF_BANTU Reef_Star_Cushion_Flipflops_Size_8_Black
        """,
        "kitchen and table": """
            ACE_Coffee_Mug_Kristen_16_oz_cup BIA_Cordon_Bleu_White_Porcelain_Utensil_Holder_900028
            Black_Decker_Stainless_Steel_Toaster_4_Slice Chefmate_8_Frypan
            Cole_Hardware_Bowl_Scirocco_YellowBlue
            JA_Henckels_International_Premio_Cutlery_Block_Set_14Piece
            Nordic_Ware_Original_Bundt_Pan Room_Essentials_Mug_White_Yellow
            Threshold_Porcelain_Teapot_White TriStar_Products_PPC_Power_Pressure_Cooker_XL_in_Black
        """,
        "house and tools": """
            Asus_80211ac_DualBand_Gigabit_Wireless_Router_RTAC68R BlueBlack_Nintendo_3DSXL
            Cole_Hardware_Hammer_Black Ecoforms_Plant_Container_GP16A_Coral HeavyDuty_Flashlight
            Hefty_Waste_Basket_Decorative_Bronze_85_liter
            Logitech_Ultimate_Ears_Boom_Wireless_Speaker_Night_Black Poppin_File_Sorter_Blue
            Razer_Naga_MMO_Gaming_Mouse Remington_TStudio_Hair_Dryer
        """,
        "packages and bottles": """
            5_HTP Animal_Crossing_New_Leaf_Nintendo_3DS_Game Balderdash_Game
            Black_Forest_Fruit_Snacks_28_Pack_Grape Crayola_Crayons_24_count
            Nescafe_16Count_Dolce_Gusto_Cappuccino_Capsules
            Pepsi_Max_Cola_Zero_Calorie_12_12_fl_oz_355_ml_cans_144_fl_oz_426_lt Perricone_MD_OVM
            Twinlab_Nitric_Fuel Whey_Protein_Vanilla
        """,
    }.items()
}
NAMES = tuple(sorted(name for group in GROUPS.values() for name in group))


@cache
def all_names() -> frozenset[str]:
    """Names of all models of the set, 1,033 with the few that its owner has withdrawn.

    Source: the table of names in MOVi (Kubric, ``challenges/movi/movi_e.py``), which includes all
    names of the evaluation.
    """
    text = (files(__package__ or "gamba_warp.data") / "gso_names.txt").read_text(encoding="utf-8")
    return frozenset(text.split())


def scanned(uids: Iterable[str]) -> list[str]:
    """Uids named as models of the set, ignoring parent folders, sorted."""
    return sorted(uid for uid in uids if uid.rpartition("/")[2] in all_names())


def names_of(path: Path | None) -> tuple[str, ...]:
    """Return the objects of the evaluation: ``NAMES``, or the names in a file, one a line.

    Raises:
        UserError: the file cannot be read, has no names, or one of them is invalid or repeated.
    """
    if path is None:
        return NAMES
    try:
        lines = read_bytes(path, _MAX_LIST).decode().split("\n")
    except UnicodeDecodeError as error:
        raise UserError(f"{path}: not UTF-8 text") from error
    names = [plain_name(line.strip(), str(path)) for line in lines if line.strip()]
    if not names:
        raise UserError(f"{path}: contains no names")
    if twice := [name for name, count in Counter(names).items() if count > 1]:
        raise UserError(f"{path}: {twice[0]} occurs twice")
    return tuple(sorted(names))


def protocol_of(there: Iterable[str], names: Sequence[str] = NAMES) -> dict[str, Any]:
    """Description of this evaluation for a report.

    Args:
        there: names of the evaluated objects.
        names: names of all its objects.

    Returns:
        The size, the poses, the missing objects of the list, and the evaluated ones outside it.
    """
    found = set(there)
    return {
        "name": "gso",
        "size": SIZE,
        "input": "view 0: elevation 0, azimuth 0 (the camera at -y, z up)",
        "views": f"{VIEWS}: azimuths 0, 45, ... 315 at elevations 0, 20 and 40 degrees",
        "list": "the 60 of the protocol" if names == NAMES else "given by --objects",
        "list_sha256": hashlib.sha256("\n".join(names).encode()).hexdigest(),
        "objects": len(names),
        "evaluated": len(found & set(names)),
        "missing": [name for name in names if name not in found],
        "others": sorted(found - set(names)),
    }
