// Controls: mouse, touch, wheel and keys, mapped to camera motions.

const TAP = { time: 300, reach: 8, between: 24 }; // milliseconds, and pixels

// `act` has turn, pan, zoom (each redraws), focus(x, y), keys: functions by the key's name, and perhaps
// paint(x, y, dx, dy, clear), for which the left button and one finger are then.
function takeHands(surface, act) {
  const down = new Map(); // positions of pointers by id
  let tap = null, moved = 0;

  const middle = () => {
    const all = [...down.values()], x = all.reduce((sum, p) => sum + p.x, 0) / all.length;
    const y = all.reduce((sum, p) => sum + p.y, 0) / all.length;
    return { x, y, spread: all.reduce((sum, p) => sum + Math.hypot(p.x - x, p.y - y), 0) / all.length };
  };

  surface.addEventListener("pointerdown", (event) => {
    surface.focus({ preventScroll: true });
    surface.setPointerCapture(event.pointerId);
    down.set(event.pointerId, { x: event.offsetX, y: event.offsetY });
    if (down.size === 1) moved = 0;
    else moved = Infinity;
  });

  surface.addEventListener("pointermove", (event) => {
    const pointer = down.get(event.pointerId);
    if (!pointer) return;
    const before = middle();
    Object.assign(pointer, { x: event.offsetX, y: event.offsetY });
    const after = middle(), dx = after.x - before.x, dy = after.y - before.y;
    if (!dx && !dy && after.spread === before.spread) return;
    moved += Math.hypot(dx, dy);
    if (down.size > 1) {
      act.pan(dx, dy);
      if (before.spread > 1 && after.spread > 1) act.zoom(before.spread / after.spread);
    } else if (act.paint && !(event.buttons & 6)) act.paint(after.x, after.y, dx, dy, event.shiftKey);
    else if (event.buttons & (act.paint ? 4 : 6) || event.shiftKey || event.ctrlKey || event.metaKey) act.pan(dx, dy);
    else act.turn(dx, dy);
  });

  const leave = (event) => {
    if (!down.delete(event.pointerId) || event.type !== "pointerup" || moved > TAP.reach || event.button)
      return;
    if (act.paint) return act.paint(event.offsetX, event.offsetY, 0, 0, event.shiftKey);
    const here = { x: event.offsetX, y: event.offsetY, time: event.timeStamp };
    const second = tap && here.time - tap.time < TAP.time
      && Math.hypot(here.x - tap.x, here.y - tap.y) < TAP.between;
    if (second) act.focus(here.x, here.y);
    tap = second ? null : here;
  };
  surface.addEventListener("pointerup", leave);
  surface.addEventListener("pointercancel", leave);
  surface.addEventListener("contextmenu", (event) => event.preventDefault());
  surface.addEventListener("wheel", (event) => {
    event.preventDefault();
    const unit = [1, 30, 300][event.deltaMode], pinch = event.ctrlKey ? 8 : 1; // a trackpad's pinch
    act.zoom(Math.exp(Math.max(-120, Math.min(120, event.deltaY * unit)) * 0.0013 * pinch));
  }, { passive: false });

  window.addEventListener("keydown", (event) => {
    if (event.altKey) return;
    const name = event.key.length === 1 ? event.key.toLowerCase() : event.key;
    const key = event.ctrlKey || event.metaKey ? act.keys[`Ctrl+${name}`]
      : act.keys[event.shiftKey ? `Shift+${name}` : name] || act.keys[name];
    const onButton = event.target.closest?.("button") && (name === "Enter" || name === " ");
    if (!key || onButton || event.target.closest?.("input")) return;
    event.preventDefault();
    key();
  });
}
