"use strict";
// Starts the viewers of a page, each in its own frame. A browser keeps only a few 3D contexts
// alive, so the oldest viewer returns to its image when there are many.
const MOST_VIEWERS = 6;
const viewers = [];

function startViewer(place) {
  const part = (name) => document.getElementById(name).textContent;
  const program = JSON.parse(part("viewer-program"));
  const frame = document.createElement("iframe");
  frame.title = "3D view";
  frame.allow = "fullscreen *";
  frame.srcdoc = program.replace(/\{\{(\w+)\}\}/g, (_, name) => part(`${place.dataset.viewer}-${name}`));
  place.append(frame);
  place.classList.add("running");
  viewers.push(place);
  if (viewers.length > MOST_VIEWERS) stopViewer(viewers.shift());
}

function stopViewer(place) {
  place.querySelector("iframe").remove();
  place.classList.remove("running");
}

for (const place of document.querySelectorAll(".viewer")) {
  place.querySelector("button").onclick = () => startViewer(place);
  if ("auto" in place.dataset) startViewer(place);
}
