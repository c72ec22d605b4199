// Directions of all views from above: the middle is vertical, the rim 90 degrees.
const SVG = "http://www.w3.org/2000/svg";

function circle(x, y, r, className) {
  const node = document.createElementNS(SVG, "circle");
  for (const [key, value] of Object.entries({ cx: x, cy: y, r, class: className })) node.setAttribute(key, value);
  return node;
}

export function drawPlan(svg, views, nowIndex) {
  const nodes = [30, 60, 90].map((tilt) => circle(0, 0, (100 * tilt) / 90, "ring"));
  for (const view of views) {
    if (!view.direction) continue;
    const [x, y, z] = view.direction;
    const aside = Math.hypot(x, y) || 1;
    const radius = (100 * Math.acos(Math.min(1, Math.max(-1, z)))) / (Math.PI / 2);
    const state = view.index === nowIndex ? "now" : view.state;
    const size = Math.min(8, Math.max(3, 3.5 / view.distance));
    const dot = circle((radius * x) / aside, (-radius * y) / aside, size, `dot ${state}`);
    const title = document.createElementNS(SVG, "title");
    title.textContent = `view ${view.index}, ${view.distance.toFixed(2)} m, ${state}`;
    dot.append(title);
    nodes.push(dot);
  }
  svg.replaceChildren(...nodes);
}

// A strip of colours from low to high, with five numbers and their unit below.
export function drawScale(node, scale) {
  node.hidden = !scale;
  if (!scale) return;
  const strip = document.createElement("div");
  strip.style.background = `linear-gradient(90deg, ${scale.colours.map((c) => `rgb(${c.join(" ")})`).join(", ")})`;
  const numbers = scale.ticks.map((text) => Object.assign(document.createElement("span"), { textContent: text }));
  numbers.at(-1).textContent += ` ${scale.unit}`;
  node.replaceChildren(strip, ...numbers);
}
