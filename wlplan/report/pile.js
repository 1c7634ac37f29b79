// The pile in three dimensions, for all pages.
"use strict";
const scene = JSON.parse(document.getElementById("scene").textContent);
const pile = (() => {
  const nx = scene.x.length, ny = scene.y.length, place = document.getElementById("pile");

  // Whole numbers of two bytes, low byte first.
  function unpacked(text) {
    const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
    const view = new DataView(bytes.buffer);
    return Array.from({ length: bytes.length / 2 }, (_, k) => view.getInt16(2 * k, true));
  }
  const first = unpacked(scene.heights), floor = unpacked(scene.floor);
  const deepest = first.reduce((most, value, k) => Math.max(most, value - floor[k]), 1);

  // Rows of y, as the surface wants them.
  function rows(value) {
    return scene.y.map((_, j) => scene.x.map((_, i) => value(i * ny + j)));
  }

  // The surface of heights in whole steps; its colour is the height of soil on the floor.
  function surface(now) {
    return { type: "surface", x: scene.x, y: scene.y, z: rows((k) => scene.lowest + scene.step * now[k]),
      surfacecolor: rows((k) => scene.step * (now[k] - floor[k])), cmin: 0, cmax: scene.step * deepest,
      showscale: false, name: "", colorscale: [[0, "#c9ced4"], [0.03, "#cbbd9d"], [1, "#8a5a22"]],
      contours: { x: { highlight: false }, y: { highlight: false }, z: { highlight: false } },
      lighting: { ambient: 0.55, diffuse: 0.8, specular: 0.05, roughness: 0.9 },
      hovertemplate: "height %{z:.2f} m<extra></extra>" };
  }

  // A box on four corners, from one height to another.
  function box(corners, low, high, colour, name) {
    const x = [], y = [], z = [];
    for (const up of [low, high])
      for (const [a, b] of corners) { x.push(a); y.push(b); z.push(up); }
    const side = [0, 1, 2, 3].flatMap((k) => [[k, (k + 1) % 4, k + 4], [(k + 1) % 4, (k + 1) % 4 + 4, k + 4]]);
    const faces = [...side, [4, 5, 6], [4, 6, 7]];
    return { type: "mesh3d", x, y, z, i: faces.map((f) => f[0]), j: faces.map((f) => f[1]),
      k: faces.map((f) => f[2]), color: colour, flatshading: true, hoverinfo: name ? "name" : "skip", name };
  }

  // Axes say the coordinates of the scan.
  function axis(low, high, offset, title) {
    const step = [1, 2, 5, 10, 20, 50, 100].find((s) => (high - low) / s <= 7) || 200;
    const ticks = [];
    for (let v = Math.ceil((low + offset) / step) * step; v - offset <= high; v += step)
      ticks.push(v);
    return { title: { text: title }, tickvals: ticks.map((v) => v - offset),
      ticktext: ticks.map((v) => v.toFixed(0)), range: [low, high], showspikes: false };
  }

  const [low, high] = scene.view;
  // A little to the side of where the trucks stand; further away where the window is narrow.
  const across = scene.side.map((v, k) => v - 0.5 * (low[k] + high[k]));
  let angle = Math.atan2(across[1], across[0]) + 0.9, above = false;
  // Metres are as long in all directions, and what is seen fills the same room however long it is.
  const top = first.reduce((most, value) => Math.max(most, value), 0) * scene.step;
  const depth = Math.max(top, 3.5), size = [high[0] - low[0], high[1] - low[1], depth];
  const ratio = size.map((side) => 2 * side / Math.hypot(size[0], size[1]) * Math.SQRT2);
  function camera() {
    const far = Math.max(1, 1.25 * place.clientHeight / place.clientWidth);
    const side = above ? 0.02 : 1.65, up = above ? 1.95 : 1.25;
    return { eye: { x: far * side * Math.cos(angle), y: far * side * Math.sin(angle), z: far * up },
      center: { x: 0, y: 0, z: -0.15 } };
  }
  const layout = {
    margin: { l: 0, r: 0, t: 0, b: 0 }, paper_bgcolor: "rgba(0,0,0,0)", uirevision: "kept", showlegend: false,
    scene: { aspectmode: "manual", aspectratio: { x: ratio[0], y: ratio[1], z: ratio[2] }, camera: camera(),
      xaxis: axis(low[0], high[0], scene.offset[0], "x, east [m]"),
      yaxis: axis(low[1], high[1], scene.offset[1], "y, north [m]"),
      zaxis: { ...axis(scene.lowest, scene.lowest + depth, scene.offset[2], ""), nticks: 4 } },
  };
  const config = { responsive: true, displaylogo: false, displayModeBar: false, scrollZoom: false };
  const draw = (traces) => Plotly.react(place, traces, layout, config);

  document.querySelectorAll(".turn").forEach((button) => button.addEventListener("click", () => {
    above = Boolean(button.dataset.above);
    angle += Number(button.dataset.turn || 0);
    Plotly.relayout(place, { "scene.camera": camera() });
  }));
  addEventListener("beforeprint", () => document.querySelectorAll("details").forEach((one) => { one.open = true; }));

  // The library that draws is packed, and part of this page.
  async function start(show) {
    try {
      const packed = Uint8Array.from(atob(document.getElementById("plotly").textContent), (c) => c.charCodeAt(0));
      const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"));
      const tag = document.createElement("script");
      tag.textContent = await new Response(stream).text();
      document.head.append(tag);
      await show();
      place.dataset.ready = "yes";
    } catch (error) {
      place.textContent = "This browser cannot draw in three dimensions: the pictures below show the same.";
      throw error;
    }
  }
  return { place, nx, ny, first, unpacked, surface, box, draw, start };
})();
