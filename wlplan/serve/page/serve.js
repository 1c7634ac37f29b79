// The page of `wlplan serve`: a scan comes in, a plan comes out. Texts of a scan are only ever text.
"use strict";
(() => {
  const facts = JSON.parse(document.getElementById("facts").textContent);
  const at = (id) => document.getElementById(id);
  const SVG = "http://www.w3.org/2000/svg";
  const map = at("map");

  // What the page shows: a scan, areas, the area that is being drawn, a truck, a plan.
  const state = { scan: null, areas: [], drawn: null, truck: null, plan: null, job: null };

  function made(name, attributes, ...inside) {
    const one = name.startsWith("svg:") ? document.createElementNS(SVG, name.slice(4)) : document.createElement(name);
    for (const [key, value] of Object.entries(attributes || {})) one.setAttribute(key, value);
    one.append(...inside);
    return one;
  }

  // --- asking the server

  async function asked(path, options) {
    let answer;
    try {
      answer = await fetch(path, options);
    } catch {
      throw new Error("the server does not answer: is wlplan serve still running?");
    }
    const found = await answer.json().catch(() => ({ error: `the server answered ${answer.status}` }));
    if (!answer.ok) throw new Error(found.error || `the server answered ${answer.status}`);
    return found;
  }
  const post = (path, values) => asked(path, {
    method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(values) });

  function say(text) { at("said").textContent = text; }
  function wrong(error) {
    at("wrong").hidden = !error;
    at("wrong").textContent = error ? error.message : "";
  }

  // --- the scan

  function working(text) {
    const begin = Date.now();
    const tell = () => say(`${text}, ${Math.round((Date.now() - begin) / 1000)} s`);
    tell();
    const timer = setInterval(tell, 1000);
    return () => { clearInterval(timer); say(""); };
  }

  async function take(file) {
    wrong(null);
    const ending = file.name.slice(file.name.lastIndexOf(".")).toLowerCase();
    if (!facts.endings.includes(ending))
      return wrong(new Error(`${file.name}: unknown kind of pile file; use one of ${facts.endings.join(", ")}`));
    if (file.size > facts.most_bytes)
      return wrong(new Error(`${file.name}: has ${(file.size / 2 ** 20).toFixed(0)} MiB, and at most ${facts.most_bytes / 2 ** 20} are taken`));
    const done = working(`reading ${file.name}`);
    try {
      show(await asked(`scan?name=${encodeURIComponent(file.name)}`, {
        method: "POST", headers: { "Content-Type": "application/octet-stream" }, body: file }));
    } catch (error) { wrong(error); } finally { done(); }
  }

  async function takeBundled() {
    wrong(null);
    const done = working("reading the bundled pile");
    try { show(await post("scan", { scan: "bundled" })); } catch (error) { wrong(error); } finally { done(); }
  }

  function numbers(text, Kind) {
    const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
    if (Kind === Uint8Array) return bytes;
    const view = new DataView(bytes.buffer);
    return Uint16Array.from({ length: bytes.length / 2 }, (_, k) => view.getUint16(2 * k, true));
  }

  function show(scan) {
    view = null;  // nothing is drawn until all is there
    Object.assign(state, { scan, areas: [], drawn: null, truck: null });
    listAreas();
    forget();
    for (const name of ["truck-x", "truck-y", "truck-heading"]) at(name).value = "";
    if (at("truck-how").value === "place") { at("truck-how").value = ""; truckHow(); }
    at("drop").classList.add("small");
    at("shown").hidden = at("asked").hidden = false;
    const { size, first, cell } = scan.raster;
    const low = first.map((v) => v - 0.5 * cell);
    state.box = { x: low[0], y: low[1], w: cell * size[0], h: cell * size[1] };
    const relief = at("relief");
    relief.setAttribute("href", painted(scan.raster));
    // Inside the flipped group y is north.
    for (const [name, value] of Object.entries({ x: 0, y: 0, width: state.box.w, height: state.box.h }))
      relief.setAttribute(name, value);
    at("map-title").textContent = scan.name;
    const [nx, ny] = scan.cells;
    at("found").textContent = `${scan.volume.toFixed(1)} m³ ± ${scan.volume_deviation.toFixed(1)}, about ${scan.tonnes.toFixed(0)} t; `
      + `${scan.piles.length} pile${scan.piles.length === 1 ? "" : "s"}, ${scan.structures.length} standing; `
      + `${(nx * scan.cell_size).toFixed(0)} by ${(ny * scan.cell_size).toFixed(0)} m` + (scan.crs ? `, ${scan.crs}` : "");
    at("scan-notes").replaceChildren(...scan.notes.map((note) => made("li", {}, note)));
    whole();
    cross = [state.box.x + 0.5 * state.box.w, state.box.y + 0.5 * state.box.h];
    drawAll();
  }

  // Colours of the report's maps: soil over its ground, what stands in grey, unseen cells pale.
  const SOIL = [[228, 226, 220], [232, 211, 168], [213, 167, 102], [169, 118, 64], [107, 71, 43]];
  function painted(raster) {
    const [nx, ny] = raster.size, height = numbers(raster.height), ground = numbers(raster.ground);
    const seen = numbers(raster.seen, Uint8Array);
    let most = 1;
    for (let k = 0; k < height.length; k++) most = Math.max(most, height[k] - ground[k]);
    const canvas = made("canvas", { width: nx, height: ny }), pen = canvas.getContext("2d");
    const picture = pen.createImageData(nx, ny);
    const slope = 1.3 * raster.step / raster.cell, up = Math.sin(0.698), flat = Math.cos(0.698) * Math.SQRT1_2;
    for (let i = 0; i < nx; i++) for (let j = 0; j < ny; j++) {
      const k = i * ny + j;
      const east = slope * (height[Math.min(i + 1, nx - 1) * ny + j] - height[Math.max(i - 1, 0) * ny + j]) / 2;
      const north = slope * (height[i * ny + Math.min(j + 1, ny - 1)] - height[i * ny + Math.max(j - 1, 0)]) / 2;
      const facing = (up + east * flat - north * flat) / Math.hypot(1, east, north);
      const light = Math.min(1.13, Math.max(0.4, 1 + 0.6 * (facing - up)));
      const part = 4 * (height[k] - ground[k]) / most, low = Math.min(3, Math.floor(part));
      const to = 4 * ((ny - 1 - j) * nx + i);
      for (let c = 0; c < 3; c++) {
        let colour = light * (SOIL[low][c] + (part - low) * (SOIL[low + 1][c] - SOIL[low][c]));
        if (!seen[k]) colour = (i + j) % 8 < 2 ? 170 : 0.25 * colour + 183;
        picture.data[to + c] = colour;
      }
      picture.data[to + 3] = 255;
    }
    pen.putImageData(picture, 0, 0);
    return canvas.toDataURL();
  }

  // --- the map: a view in metres of the scan, from its lower left corner

  const BESIDE = 8;
  let view = null, cross = null;
  const local = ([x, y]) => [x - state.box.x, y - state.box.y];
  function whole() {
    const { clientWidth: w, clientHeight: h } = map, box = state.box;
    // A tab behind another may have no size; it is told when it has one again.
    if (!w || !h) return;
    // Trucks often stand beside the scan.
    const scale = Math.max((box.w + 2 * BESIDE) / w, (box.h + 2 * BESIDE) / h);
    view = { x: 0.5 * (box.w - scale * w), y: 0.5 * (box.h - scale * h), scale };
  }
  // A point on the screen, in the coordinates of the scan.
  function place(event) {
    const frame = map.getBoundingClientRect();
    const px = event.clientX - frame.left - map.clientLeft, py = event.clientY - frame.top - map.clientTop;
    return [state.box.x + view.x + view.scale * px, state.box.y + view.y + view.scale * (map.clientHeight - py)];
  }
  function zoom(factor, around) {
    const [x, y] = local(around || centre());
    view = { x: x + (view.x - x) * factor, y: y + (view.y - y) * factor, scale: view.scale * factor };
    drawAll();
  }
  const centre = () => [state.box.x + view.x + 0.5 * view.scale * map.clientWidth,
    state.box.y + view.y + 0.5 * view.scale * map.clientHeight];
  const points = (list) => list.map((p) => local(p).map((v) => v.toFixed(3)).join(",")).join(" ");
  const tool = () => document.querySelector("input[name=tool]:checked").value;

  function drawAll() {
    if (!view) return;
    const { clientWidth: w, clientHeight: h } = map;
    map.setAttribute("viewBox", `0 0 ${w} ${h}`);
    at("flipped").setAttribute("transform",
      `translate(${-view.x / view.scale} ${h + view.y / view.scale}) scale(${1 / view.scale} ${-1 / view.scale})`);
    // The picture has its first row in the north.
    at("relief").setAttribute("transform", `translate(0 ${state.box.h}) scale(1 -1)`);
    map.classList.toggle("moves", tool() === "move");
    drawTicks(w, h); drawAreas(); drawTruck(); drawPlan(); drawCross(); help();
  }

  function drawTicks(w, h) {
    const step = [0.5, 1, 2, 5, 10, 20, 50, 100, 200].find((s) => s / view.scale >= 70) || 500;
    const inside = [], digits = step < 1 ? 1 : 0;
    const line = (x1, y1, x2, y2) => made("svg:line", { x1, y1, x2, y2, stroke: "#1d2733", "stroke-opacity": 0.13 });
    const word = (x, y, text, anchor) => made("svg:text", { x, y, "font-size": 11, "stroke-width": 3, "text-anchor": anchor }, text);
    const west = state.box.x + view.x, south = state.box.y + view.y;
    for (let x = Math.ceil(west / step) * step; x < west + w * view.scale; x += step) {
      const px = (x - west) / view.scale;
      inside.push(line(px, 0, px, h), word(px, h - 5, x.toFixed(digits), "middle"));
    }
    for (let y = Math.ceil(south / step) * step; y < south + h * view.scale; y += step) {
      const py = h - (y - south) / view.scale;
      if (py > 20 && py < h - 20) inside.push(line(0, py, w, py), word(5, py + 4, y.toFixed(digits), "start"));
    }
    inside.push(word(w - 8, h - 20, "x, east [m]", "end"), word(5, 14, "y, north [m]", "start"));
    at("ticks").replaceChildren(...inside);
  }

  function drawAreas() {
    const px = view.scale, inside = [];
    for (const area of state.areas)
      if (area.corners.length > 2) inside.push(made("svg:polygon", { class: area.kind, points: points(area.corners), "stroke-width": 1.5 * px }));
    if (state.drawn) {
      inside.push(made("svg:polyline", { class: "drawn", points: points([...state.drawn, cross]), "stroke-width": 2 * px }));
      for (const [x, y] of state.drawn.map(local)) inside.push(made("svg:circle", { cx: x, cy: y, r: 4 * px, fill: "#b02a2a" }));
    }
    at("areas").replaceChildren(...inside);
  }

  // The loader as it dumps, and the truck across its heading.
  function stand(x, y, heading) {
    const px = view.scale, [sx, sy] = local([x, y]), inside = [];
    if (heading === null) {
      inside.push(made("svg:circle", { cx: sx, cy: sy, r: Math.max(1.6, 6 * px), fill: "none", stroke: "#3a7d44", "stroke-width": 3 * px }),
        made("svg:circle", { cx: sx, cy: sy, r: 3 * px, fill: "#3a7d44" }));
      return inside;
    }
    const [near, far, half] = facts.truck;
    inside.push(made("svg:g", { transform: `translate(${sx} ${sy}) rotate(${heading})` },
      made("svg:rect", { x: near, y: -half, width: far - near, height: 2 * half, fill: "#3a7d44", stroke: "#fff", "stroke-width": px }),
      made("svg:path", { d: `M -4 0 H -0.4`, stroke: "#1d2733", "stroke-width": 2.5 * px, fill: "none" }),
      made("svg:path", { d: "M 0.4 0 L -0.9 0.6 L -0.9 -0.6 Z", fill: "#1d2733" })));
    return inside;
  }
  function drawTruck() {
    const inside = [];
    const planned = state.plan ? stands(state.plan) : [];
    // What was planned says the heading that was left open.
    const same = (one) => state.truck && Math.hypot(one[0] - state.truck[0], one[1] - state.truck[1]) < 0.01;
    if (state.truck && !planned.some(same)) inside.push(...stand(...state.truck));
    for (const one of planned) if (!state.truck || same(one)) inside.push(...stand(...one));
    at("truck").replaceChildren(...inside);
  }
  function stands(plan) {
    const [dx, dy] = plan.frame.offset, records = (plan.trucks || []).filter((one) => "x" in one);
    const found = (records.length ? records : [plan.receiver]).map((one) => [one.x + dx, one.y + dy, one.heading * 180 / Math.PI]);
    return [...new Map(found.map((one) => [one.join(), one])).values()];
  }

  function drawPlan() {
    const ways = [], digs = [], px = view.scale;
    if (state.plan) {
      const [dx, dy] = state.plan.frame.offset;
      for (const load of state.plan.loads)
        for (const leg of legs(load.path ? load.path.points : []))
          ways.push(made("svg:polyline", { points: points(leg.points.map((p) => [p[0] + dx, p[1] + dy])), fill: "none",
            stroke: "#1d2733", "stroke-opacity": 0.5, "stroke-width": 1.5 * px, ...(leg.gear < 0 ? { "stroke-dasharray": `${5 * px} ${4 * px}` } : {}) }));
      state.plan.loads.forEach((load, n) => {
        const [x, y] = local([load.x + dx, load.y + dy]), into = load.heading;
        digs.push(made("svg:path", { d: `M ${x - facts.approach * Math.cos(into)} ${y - facts.approach * Math.sin(into)} L ${x} ${y}`, stroke: "#1f5fa8", "stroke-width": 2.5 * px }),
          made("svg:circle", { cx: x, cy: y, r: 9 * px, fill: "#1f5fa8", stroke: "#fff", "stroke-width": px }),
          made("svg:text", { transform: `translate(${x} ${y}) scale(${px} ${-px})`, "font-size": 11 }, String(n + 1)));
      });
    }
    at("ways").replaceChildren(...ways);
    at("digs").replaceChildren(...digs);
  }
  function legs(list) {
    const found = [];
    list.forEach((point, k) => {
      const gear = point[3], last = found[found.length - 1];
      if (!last || last.gear !== gear) found.push({ gear, points: k ? [list[k - 1], point] : [point] });
      else last.points.push(point);
    });
    return found;
  }

  function drawCross() {
    const px = view.scale, [x, y] = local(cross), inside = [];
    if (document.activeElement === map && map.matches(":focus-visible"))
      inside.push(made("svg:path", { d: `M ${x - 10 * px} ${y} h ${20 * px} M ${x} ${y - 10 * px} v ${20 * px}`, stroke: "#b85c00", "stroke-width": 2 * px }));
    at("cross").replaceChildren(...inside);
    at("where").textContent = `x ${cross[0].toFixed(1)}, y ${cross[1].toFixed(1)} m.`;
  }
  const HELP = {
    truck: "Click where the loader dumps, and drag the way it then looks: the truck stands across that.",
    area: "Click corner after corner; a double click, or Enter twice at one place, ends the area, Escape gives it up.",
    move: "Drag to move; the wheel, + and − zoom.",
  };
  function help() { at("tool-help").textContent = HELP[tool()]; }

  // --- clicks and keys on the map

  function putTruck(x, y, heading) {
    state.truck = [x, y, heading];
    at("truck-how").value = "place";
    truckHow();
    at("truck-x").value = x.toFixed(2);
    at("truck-y").value = y.toFixed(2);
    at("truck-heading").value = heading === null ? "" : heading.toFixed(0);
    drawAll();
  }
  function putCorner(point) {
    const drawn = state.drawn || [], last = drawn[drawn.length - 1];
    if (last && Math.hypot(point[0] - last[0], point[1] - last[1]) < 4 * view.scale) return endArea();
    state.drawn = [...drawn, point];
    drawAll();
  }
  function endArea() {
    if (state.drawn && state.drawn.length > 2) state.areas.push({ kind: "no-go", corners: state.drawn });
    state.drawn = null;
    listAreas();
    drawAll();
  }

  let held = null;
  map.addEventListener("pointerdown", (event) => {
    if (event.button !== 0) return;
    map.setPointerCapture(event.pointerId);
    held = { at: place(event), px: [event.clientX, event.clientY], view: { ...view } };
    cross = held.at;
    if (tool() === "truck") putTruck(...held.at, null);
    drawAll();
  });
  map.addEventListener("pointermove", (event) => {
    if (!state.scan) return;
    const here = place(event);
    if (held && tool() === "truck") {
      const [dx, dy] = [here[0] - held.at[0], here[1] - held.at[1]];
      if (Math.hypot(dx, dy) > 10 * view.scale) putTruck(...held.at, Math.atan2(dy, dx) * 180 / Math.PI);
      return;
    }
    if (held && tool() === "move") {
      view = { ...held.view, x: held.view.x - view.scale * (event.clientX - held.px[0]), y: held.view.y + view.scale * (event.clientY - held.px[1]) };
      drawAll();
      return;
    }
    cross = here;
    if (state.drawn) drawAreas();
    drawCross();
  });
  map.addEventListener("pointerup", (event) => {
    if (held && tool() === "area") putCorner(place(event));
    held = null;
  });
  map.addEventListener("wheel", (event) => {
    if (!state.scan || tool() !== "move") return;
    event.preventDefault();
    zoom(event.deltaY > 0 ? 1.2 : 1 / 1.2, place(event));
  }, { passive: false });
  map.addEventListener("keydown", (event) => {
    const step = event.shiftKey ? 0.1 : 1;
    const moves = { ArrowLeft: [-step, 0], ArrowRight: [step, 0], ArrowUp: [0, step], ArrowDown: [0, -step] };
    if (event.key in moves) cross = [cross[0] + moves[event.key][0], cross[1] + moves[event.key][1]];
    else if (event.key === "Enter" && tool() === "truck") putTruck(...cross, state.truck ? state.truck[2] : null);
    else if (event.key === "Enter" && tool() === "area") putCorner(cross);
    else if (event.key === "Escape") state.drawn = null;
    else if (event.key === "+") zoom(1 / 1.3, cross);
    else if (event.key === "-") zoom(1.3, cross);
    else return;
    event.preventDefault();
    drawAll();
  });
  for (const name of ["focus", "blur"]) map.addEventListener(name, () => view && drawCross());
  at("closer").addEventListener("click", () => zoom(1 / 1.4));
  at("further").addEventListener("click", () => zoom(1.4));
  at("whole").addEventListener("click", () => { whole(); drawAll(); });
  for (const one of document.querySelectorAll("input[name=tool]")) one.addEventListener("change", () => { state.drawn = null; drawAll(); });
  addEventListener("resize", () => { if (state.scan) { whole(); drawAll(); } });

  // --- the form

  function truckHow() {
    const here = at("truck-how").value === "place";
    document.querySelector("[data-truck]").hidden = !here;
    if (!here) { state.truck = null; drawAll(); } else typedTruck();
  }
  function typedTruck() {
    const [x, y, heading] = ["truck-x", "truck-y", "truck-heading"].map((name) => at(name).value === "" ? null : Number(at(name).value));
    state.truck = x === null || y === null ? null : [x, y, heading];
    drawAll();
  }
  at("truck-how").addEventListener("change", truckHow);
  for (const name of ["truck-x", "truck-y", "truck-heading"]) at(name).addEventListener("input", typedTruck);
  at("amount").addEventListener("change", () => {
    for (const one of document.querySelectorAll("[data-amount]")) one.hidden = one.dataset.amount !== at("amount").value;
  });

  function listAreas() {
    at("area-list").replaceChildren(...state.areas.map((area, n) => {
      const kind = made("select", { id: `kind-${n}` },
        ...[["no-go", "nothing drives there"], ["no-dig", "nothing is dug there"], ["obstacle", "something stands there"]]
          .map(([value, text]) => made("option", { value, ...(value === area.kind ? { selected: "" } : {}) }, text)));
      kind.addEventListener("change", () => { area.kind = kind.value; drawAreas(); });
      const corners = made("textarea", { id: `corners-${n}`, spellcheck: "false" });
      corners.value = area.corners.map((p) => p.map((v) => v.toFixed(2)).join(", ")).join("\n");
      corners.addEventListener("input", () => {
        area.corners = corners.value.split("\n").map((line) => line.split(/[,;\s]+/).filter(Boolean).map(Number))
          .filter((p) => p.length === 2 && p.every(Number.isFinite));
        drawAreas();
      });
      const remove = made("button", { type: "button", class: "plain" }, `Remove area ${n + 1}`);
      remove.addEventListener("click", () => { state.areas.splice(n, 1); listAreas(); drawAreas(); at("add-area").focus(); });
      return made("div", { class: "area" }, made("label", { for: `kind-${n}` }, `Area ${n + 1}`), kind,
        made("label", { for: `corners-${n}` }, "Corners, x and y [m], one a line"), corners, remove);
    }));
  }
  at("add-area").addEventListener("click", () => {
    state.areas.push({ kind: "no-go", corners: [] });
    listAreas();
    at(`corners-${state.areas.length - 1}`).focus();
  });

  function settings() {
    const amount = at("amount").value, how = at("truck-how").value;
    const asks = { scan: state.scan.scan, background: true, world: at("world").value, planner: at("planner").value, referee: at("referee").checked };
    if (amount === "empty") asks.empty = true;
    else asks[amount] = Number(at(amount).value);
    if (amount === "trucks") asks.payload = Number(at("payload").value);
    if (at("objective").value) asks.objective = at("objective").value;
    if (how === "place") {
      if (!state.truck) throw new Error("the truck has no place yet: click on the map, or type x and y.");
      asks.truck = state.truck[2] === null ? state.truck.slice(0, 2) : state.truck;
    } else if (how) asks.truck = how;
    if (state.areas.length) asks.keep_out = { type: "FeatureCollection", features: state.areas.map((area) => ({
      type: "Feature", properties: { kind: area.kind }, geometry: { type: "Polygon", coordinates: [[...area.corners, ...area.corners.slice(0, 1)]] } })) };
    return asks;
  }

  // --- planning

  const pause = (seconds) => new Promise((resolve) => setTimeout(resolve, 1000 * seconds));
  function busy(is) { at("plan").disabled = is; at("stop").hidden = !is; at("stop").disabled = false; if (!is) at("far").hidden = true; }

  at("asked").addEventListener("submit", async (event) => {
    event.preventDefault();
    if (state.job) return;
    wrong(null);
    forget();
    busy(true);
    try {
      state.job = (await post("plan", settings())).job;
      const done = await followed(state.job);
      const plan = await asked(`plans/${done.plan}/plan.json`);
      told(done, plan);
    } catch (error) { wrong(error); say(""); } finally { state.job = null; busy(false); }
  });
  async function followed(job) {
    for (;;) {
      const found = await asked(`jobs/${job}`);
      if (found.state === "done") return found;
      if ("error" in found) throw new Error(found.error);
      say((found.stopping ? "stopping; " : "") + found.said);
      at("far").hidden = found.total === null;
      if (found.total !== null) { at("far").max = found.total; at("far").value = found.done; }
      await pause(0.7);
    }
  }
  at("stop").addEventListener("click", () => {
    at("stop").disabled = true;
    post(`jobs/${state.job}/stop`, {}).catch(wrong);
  });
  addEventListener("pagehide", () => { if (state.job) navigator.sendBeacon(`jobs/${state.job}/stop`); });

  // --- the plan

  function forget() { state.plan = null; at("result").hidden = true; drawAll(); }
  const shown = (value, digits) => typeof value === "number" && Number.isFinite(value) ? value.toFixed(digits).replace("-", "−") : "–";
  const minutes = (s) => s === null ? "–" : s < 60 ? `${s.toFixed(0)} s` : `${Math.floor(Math.round(s) / 60)} min ${String(Math.round(s) % 60).padStart(2, "0")} s`;

  function told(done, plan) {
    state.plan = plan;
    const job = done.headline;
    const card = (name, value, more) => made("div", { class: "card" }, made("h3", {}, name), made("div", { class: "big" }, value), made("p", {}, more));
    const parts = ["digging", "driving", "dumping"].map((name) => `${name} ${shown(job[name], 0)} s`);
    if (job.waiting) parts.push(`waiting ${shown(job.waiting, 0)} s`);
    at("cards").replaceChildren(
      card("Loaded", `${shown(job.mass, 1)} t`, `in ${job.loads} load${job.loads === 1 ? "" : "s"}`),
      ...done.trucks.map((line) => { const [who, what] = line.split(": "); return card(who, what.split(" in ")[0], `in ${what.split(" in ")[1]}`); }),
      card("Time", minutes(job.time), parts.join(", ")),
      card("Rate", `${shown(job.rate, 0)} t/h`, "all of that time counted"),
      card("Energy", `${shown(job.energy, 1)} MJ`, `about ${shown(job.fuel, 1)} l of diesel`));
    at("plan-notes").replaceChildren(...plan.notes.map((note) => made("li", {}, note)));
    at("plan-notes").hidden = !plan.notes.length;
    at("files").replaceChildren(...done.files.map((name) => made("a", { href: `plans/${done.plan}/${name}`, ...(name.endsWith(".html") || name.endsWith(".png") ? { target: "_blank", rel: "noopener" } : { download: "" }) }, name)));
    const [dx, dy] = plan.frame.offset;
    const cell = (text, kind) => made("td", {}, made("span", kind ? { class: kind } : {}, text));
    at("loads-table").replaceChildren(...plan.loads.map((load, n) => made("tr", {}, made("th", { scope: "row" }, String(n + 1)),
      cell(shown(load.x + dx, 2)), cell(shown(load.y + dy, 2)), cell(shown(load.heading * 180 / Math.PI, 0)),
      ...[["mass", 2], ["time", 1]].flatMap(([name, digits]) => [cell(shown((load.predicted || {})[name], digits), "p"), cell(shown((load.simulated || {})[name], digits), "s")]),
      cell(shown((load.transport || {}).time, 1)))));
    at("result").hidden = false;
    say(done.stopped ? "stopped: this is the best plan until then" : "the plan is made, and played in the simulator");
    drawAll();
    at("result-title").focus({ preventScroll: true });
  }

  // --- dropping and choosing

  const drop = at("drop");
  for (const name of ["dragover", "drop"]) addEventListener(name, (event) => event.preventDefault());
  addEventListener("dragover", () => drop.classList.add("over"));
  addEventListener("dragleave", () => drop.classList.remove("over"));
  addEventListener("drop", (event) => {
    drop.classList.remove("over");
    if (event.dataTransfer.files.length) take(event.dataTransfer.files[0]);
  });
  at("file").addEventListener("change", () => { if (at("file").files.length) take(at("file").files[0]); });
  at("bundled").addEventListener("click", takeBundled);
})();
