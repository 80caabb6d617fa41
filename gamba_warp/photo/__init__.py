"""Cut-outs of objects from photographs: masks, mattes and GrabCut."""
