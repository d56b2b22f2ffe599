/* The 3D point cloud: draws what app/widgets/cloud.py sends, with the vtk.js that Panel bundles.
 *
 * Coordinates are the server's: metres, x right, y away from the sensor, z up. A change only marks
 * what is out of date; the next animation frame applies all changes and draws once, so that the
 * buffers of two updates never mix.
 */

const VIEW_ANGLE_DEG = 20
const HALF_VIEW = Math.tan((VIEW_ANGLE_DEG * Math.PI) / 360)
const LABEL_ROOM_PX = [75, 40] // beside and above the box in the home view, for tick labels
const LINE_PX = 17 // height of a line of the caption
const LABEL_LETTER_PX = 6 // width of an average letter of a label
const BOX_INK = 0.25 // share of the text colour in the lines of the box
const CLICK_MOVE_PX = 4 // a press that moves less than this is a click, not a drag
const PICK_PX = 12
const POINT_SIZE = 1.4 // diameter over the distance between neighbouring points
const KEY_TURN = Math.PI / 36
const KEY_ZOOM = 1.15
const CAMERA_EVENT = "firstphoton:camera" // a linked camera has moved
const MAX_PIXEL_RATIO = 2 // more costs frame rate and shows no more detail

/* Fragment shaders of one point; p runs over the point's square from -1 to 1. A disc with a darker
 * rim, or a plain square where there are too few pixels for a rim. */
const DISC = `
  float r = length(p);
  float step = fwidth(p.x);
  if (step < 0.5) {
    if (r > 1.0) discard;
    gl_FragData[0].rgb *= 1.0 - 0.3 * smoothstep(0.6, 1.0, r);
    gl_FragData[0].a *= 1.0 - smoothstep(1.0 - step, 1.0, r);
  }`
const CROSS = `
  float arm = min(abs(p.x - p.y), abs(p.x + p.y));
  if (arm > 0.45) discard;
  gl_FragData[0].a *= 1.0 - smoothstep(0.45 - fwidth(p.x), 0.45, arm);`
// Light ring between two dark ones, in front of everything: visible on any colour and background.
const RING = `
  float r = length(p);
  if (r > 1.0 || r < 0.55) discard;
  gl_FragData[0].rgb = vec3(r > 0.64 && r < 0.88 ? 1.0 : 0.05);
  gl_FragDepth = 0.0;`

const STYLE = `
.cloud { position: relative; width: 100%; height: 100%; min-height: 120px; overflow: hidden;
  display: flex; flex-direction: column; color: var(--ink); background: var(--paper);
  font: 12px/${LINE_PX}px var(--mui-font-family, Roboto, system-ui, sans-serif); }
.stage { position: relative; flex: 1; min-height: 0; cursor: grab; touch-action: none;
  user-select: none; -webkit-user-select: none; outline: none; }
.stage:active { cursor: grabbing; }
.stage:focus-visible { outline: 2px solid #4c8dff; outline-offset: -2px; }
.stage canvas { display: block; width: 100%; height: 100%; }
.tick { position: absolute; left: 0; top: 0; white-space: nowrap; pointer-events: none;
  font-size: 11px; font-variant-numeric: tabular-nums;
  text-shadow: 0 0 3px var(--paper), 0 0 3px var(--paper); }
/* Two lines from the start: the cloud keeps its size. */
.caption { min-height: ${2 * LINE_PX}px; margin: 0 8px 6px; white-space: pre-line; }
.caption:empty { display: none; }
.tools { position: absolute; top: 6px; right: 6px; display: flex; gap: 2px; }
.tools button { all: unset; box-sizing: border-box; width: 28px; height: 28px; padding: 5px;
  border-radius: 6px; cursor: pointer; opacity: 0.75; background: var(--paper); }
.tools button:hover, .tools button:focus-visible { opacity: 1;
  background: color-mix(in srgb, currentColor 15%, var(--paper)); }
.tools button:focus-visible { outline: 2px solid #4c8dff; }
.tools svg { display: block; width: 18px; height: 18px; fill: none; stroke: currentColor;
  stroke-width: 1.8; stroke-linecap: round; stroke-linejoin: round; }
.problem { position: absolute; inset: 0; display: grid; place-items: center; padding: 1em;
  text-align: center; }
.problem:empty { display: none; }`

const HOME_ICON = "M3 11l9-8 9 8M6 9.5V20h12V9.5"

// ---------------------------------------------------------------------------- small helpers

function element(tag, attributes = {}, ...children) {
  const node = document.createElement(tag)
  for (const [name, value] of Object.entries(attributes)) node.setAttribute(name, value)
  node.append(...children)
  return node
}

function button(title, path, onClick) {
  const node = element("button", {type: "button", title, "aria-label": title})
  node.innerHTML = `<svg viewBox="0 0 24 24" aria-hidden="true"><path d="${path}"/></svg>`
  node.addEventListener("click", onClick)
  return node
}

const clamp = (value, low, high) => Math.min(high, Math.max(low, value))
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2]

function corners(bounds) {
  const [x0, x1, y0, y1, z0, z1] = bounds
  const all = []
  for (const x of [x0, x1]) for (const y of [y0, y1]) for (const z of [z0, z1]) all.push([x, y, z])
  return all
}

/* Red, green and blue of "#rrggbb", each from 0 to 1. */
const channels = (color) => [1, 3, 5].map((at) => parseInt(color.slice(at, at + 2), 16) / 255)

/* Round numbers between low and high, about `count` of them, as [value, text] pairs. */
function ticks(low, high, count) {
  const rough = (high - low) / count
  const power = 10 ** Math.floor(Math.log10(rough))
  const step = power * [1, 2, 5, 10].find((factor) => factor * power >= rough)
  const digits = Math.max(0, -Math.floor(Math.log10(step) + 1e-9))
  const found = []
  for (let k = Math.ceil(low / step - 1e-6); k * step <= high + 1e-6 * step; k++) {
    found.push([k * step, (k * step).toFixed(digits).replace("-", "\u2212")])
  }
  return found
}

// ---------------------------------------------------------------------------- camera

/* A camera on a sphere around a focal point; z stays up, so the scene never tilts. */
class Orbit {
  azimuth = 0
  elevation = 0
  distance = 1
  homeDistance = 1
  focal = [0, 0, 0]

  /* Copy the view of another camera. */
  follow({azimuth, elevation, distance, homeDistance, focal}) {
    Object.assign(this, {azimuth, elevation, distance, homeDistance, focal: [...focal]})
  }

  basis() {
    const [sa, ca] = [Math.sin(this.azimuth), Math.cos(this.azimuth)]
    const [se, ce] = [Math.sin(this.elevation), Math.cos(this.elevation)]
    return {right: [ca, sa, 0], up: [-sa * se, ca * se, ce], back: [sa * ce, -ca * ce, se]}
  }

  eye() {
    const {back} = this.basis()
    return this.focal.map((value, axis) => value + this.distance * back[axis])
  }

  turn(azimuth, elevation) {
    this.azimuth += azimuth
    this.elevation = clamp(this.elevation + elevation, -1.55, 1.55)
  }

  zoom(factor) {
    const {homeDistance} = this
    this.distance = clamp(this.distance / factor, 0.01 * homeDistance, 20 * homeDistance)
  }

  pan(dx, dy, height) {
    const {right, up} = this.basis()
    const metres = (2 * HALF_VIEW * this.distance) / height
    this.focal = this.focal.map((v, axis) => v + metres * (dy * up[axis] - dx * right[axis]))
  }

  /* View from the sensor's side, raised and to the right; less so for a scene much deeper than
   * wide, which a steep view would show as a thin streak. */
  home(bounds, width, height) {
    const [x0, x1, y0, y1, z0, z1] = bounds
    const size = Math.max(x1 - x0, z1 - z0)
    const slope = Math.min(0.7, (1.6 * size) / Math.max(y1 - y0, 1e-9))
    this.azimuth = Math.atan(slope)
    this.elevation = 0.55 * this.azimuth
    this.focal = [(x0 + x1) / 2, (y0 + y1) / 2, (z0 + z1) / 2]
    const free = (pixels, label) => Math.max(pixels - 2 * label, pixels / 2) / height
    const across = this.fit(bounds, "right", HALF_VIEW * free(width, LABEL_ROOM_PX[0]))
    const upward = this.fit(bounds, "up", HALF_VIEW * free(height, LABEL_ROOM_PX[1]))
    const {right, up} = this.basis()
    this.focal = this.focal.map((v, k) => v + across.shift * right[k] + upward.shift * up[k])
    this.distance = this.homeDistance = Math.max(across.distance, upward.distance, 1e-3)
  }

  /* The smallest distance, with its sideways shift, at which the box spans at most `slope` to
   * either side: a corner at (s, b) along (side, back) requires
   * |s - shift| <= slope (distance - b). */
  fit(bounds, side, slope) {
    const basis = this.basis()
    let [plus, minus] = [-Infinity, -Infinity]
    for (const corner of corners(bounds)) {
      const from = corner.map((value, axis) => value - this.focal[axis])
      const [s, b] = [dot(from, basis[side]), slope * dot(from, basis.back)]
      plus = Math.max(plus, b + s)
      minus = Math.max(minus, b - s)
    }
    return {distance: (plus + minus) / (2 * slope), shift: (plus - minus) / 2}
  }

  /* Return a function that projects (px, py, pz) to [x, y, depth] on a picture of this size. */
  projector(width, height) {
    const eye = this.eye()
    const {right, up, back} = this.basis()
    const scale = height / (2 * HALF_VIEW)
    return (px, py, pz, out) => {
      const [dx, dy, dz] = [px - eye[0], py - eye[1], pz - eye[2]]
      const depth = -(dx * back[0] + dy * back[1] + dz * back[2])
      out[0] = width / 2 + (scale * (dx * right[0] + dy * right[1] + dz * right[2])) / depth
      out[1] = height / 2 - (scale * (dx * up[0] + dy * up[1] + dz * up[2])) / depth
      out[2] = depth
      return out
    }
  }
}

// ---------------------------------------------------------------------------- vtk.js objects

/* One actor of points whose size on screen follows perspective but never falls below `smallest`
 * pixels; its property "point size" is the size in pixels at a depth of 1 m. */
class Points {
  constructor(vtk, renderer, paint, smallest) {
    this.poly = vtk.Common.DataModel.vtkPolyData.newInstance()
    this.mapper = vtk.Rendering.Core.vtkMapper.newInstance()
    this.actor = vtk.Rendering.Core.vtkActor.newInstance()
    this.colors = vtk.Common.Core.vtkDataArray.newInstance({
      name: "rgb", numberOfComponents: 3, values: new Uint8Array(0),
    })
    this.cells = new Uint32Array(0)
    this.mapper.setInputData(this.poly)
    this.mapper.setColorModeToDirectScalars()
    this.mapper.getViewSpecificProperties().OpenGL = {ShaderReplacements: [
      {shaderType: "Vertex", replaceFirst: false, replaceAll: false,
        originalValue: "gl_PointSize = pointSize;",
        replacementValue: `gl_PointSize = max(pointSize / gl_Position.w, ${smallest.toFixed(1)});`},
      {shaderType: "Fragment", replaceFirst: true, replaceAll: false,
        originalValue: "//VTK::Picking::Impl",
        replacementValue: `vec2 p = 2.0 * gl_PointCoord - 1.0;${paint}\n//VTK::Picking::Impl`},
    ]}
    this.actor.setMapper(this.mapper)
    this.actor.getProperty().setLighting(false)
    this.actor.setVisibility(false)
    renderer.addActor(this.actor)
  }

  set(xyz, rgb = null) {
    const count = xyz.length / 3
    if (this.cells.length < 2 * count) {
      this.cells = new Uint32Array(2 * count)
      for (let i = 0; i < count; i++) this.cells.set([1, i], 2 * i)
    }
    this.actor.setVisibility(count > 0)
    this.poly.getPoints().setData(xyz, 3)
    this.poly.getVerts().setData(this.cells.subarray(0, 2 * count))
    this.mapper.setScalarVisibility(rgb !== null)
    if (rgb !== null) {
      this.colors.setData(rgb, 3)
      this.poly.getPointData().setScalars(this.colors)
    }
    this.poly.modified()
  }

  delete() {
    for (const part of [this.actor, this.mapper, this.poly, this.colors]) part.delete()
  }
}

/* The box around the target, a metric grid on its floor, and the tick labels beside it. */
class Box {
  constructor(vtk, renderer, holder) {
    this.holder = holder
    this.labels = []
    this.bounds = null
    this.poly = vtk.Common.DataModel.vtkPolyData.newInstance()
    this.mapper = vtk.Rendering.Core.vtkMapper.newInstance()
    this.actor = vtk.Rendering.Core.vtkActor.newInstance()
    this.mapper.setInputData(this.poly)
    this.actor.setMapper(this.mapper)
    this.actor.getProperty().setLighting(false)
    renderer.addActor(this.actor)
  }

  set(bounds) {
    const [x0, x1, y0, y1, z0, z1] = bounds
    const longest = Math.max(x1 - x0, y1 - y0, z1 - z0)
    this.ticks = [0, 2, 4].map((k) => {
      const share = (bounds[k + 1] - bounds[k]) / longest
      return ticks(bounds[k], bounds[k + 1], clamp(Math.round(5 * share), 2, 5))
    })
    const lines = []
    for (const [a, b] of [[x0, y0], [x1, y0], [x0, y1], [x1, y1]]) lines.push([a, b, z0, a, b, z1])
    for (const z of [z0, z1]) {
      lines.push([x0, y0, z, x1, y0, z], [x0, y1, z, x1, y1, z])
      lines.push([x0, y0, z, x0, y1, z], [x1, y0, z, x1, y1, z])
    }
    for (const [x] of this.ticks[0]) lines.push([x, y0, z0, x, y1, z0])
    for (const [y] of this.ticks[1]) lines.push([x0, y, z0, x1, y, z0])
    this.poly.getPoints().setData(Float32Array.from(lines.flat()), 3)
    const cells = lines.flatMap((_, i) => [2, 2 * i, 2 * i + 1])
    this.poly.getLines().setData(Uint32Array.from(cells))
    this.poly.modified()
    this.actor.setVisibility(true)
    this.bounds = bounds
  }

  clear() {
    this.actor.setVisibility(false)
    this.bounds = null
    this.show([])
  }

  /* Place the labels outside the box: across along the near bottom edge, distance along the bottom
   * edge on the viewer's side, height along the upright edge farthest left. */
  place(eye, project, width, height) {
    const [x0, x1, y0, y1, z0, z1] = this.bounds
    const near = eye[1] < (y0 + y1) / 2 ? y0 : y1
    const side = eye[0] > (x0 + x1) / 2 ? x1 : x0
    const at = (x, y, z) => project(x, y, z, [0, 0, 0])
    const uprights = [[x0, y0], [x1, y0], [x0, y1], [x1, y1]]
    const [ux, uy] = uprights.sort((a, b) => at(...a, z0)[0] - at(...b, z0)[0])[0]
    const labels = [
      ...this.edge(0, (v) => [v, near, z0], "across (m)", at),
      ...this.edge(1, (v) => [side, v, z0], "distance (m)", at),
      ...this.edge(2, (v) => [ux, uy, v], "height (m)", at),
    ].filter(({x, y, anchor, text}) => {
      const left = x + anchor * text.length * LABEL_LETTER_PX
      return left > 0 && left + text.length * LABEL_LETTER_PX < width && y > 6 && y < height - 6
    })
    this.show(labels)
  }

  show(shown) {
    while (this.labels.length < shown.length) {
      const label = element("span", {class: "tick", "aria-hidden": "true"})
      this.labels.push(this.holder.appendChild(label))
    }
    this.labels.forEach((label, i) => {
      label.hidden = i >= shown.length
      if (label.hidden) return
      const {x, y, anchor, text} = shown[i]
      if (label.textContent !== text) label.textContent = text
      label.style.transform = `translate(${x.toFixed(1)}px, ${y.toFixed(1)}px)
        translate(${(100 * anchor).toFixed(1)}%, -50%)`
    })
    this.shown = shown
  }

  /* Labels of one edge, away from the middle of the box, and farther out the edge's name. */
  edge(axis, point, name, at) {
    const [x0, x1, y0, y1, z0, z1] = this.bounds
    const middle = at((x0 + x1) / 2, (y0 + y1) / 2, (z0 + z1) / 2)
    const outside = (value, text, gap, more) => {
      const [x, y, depth] = at(...point(value))
      const length = Math.hypot(x - middle[0], y - middle[1]) || 1
      const [dx, dy] = [(x - middle[0]) / length, (y - middle[1]) / length]
      const away = gap + more * Math.abs(dx)
      return {x: depth > 0 ? x + away * dx : -1, y: y + away * dy, anchor: (dx - 1) / 2, text}
    }
    const half = (this.bounds[2 * axis] + this.bounds[2 * axis + 1]) / 2
    const numbers = this.ticks[axis].map(([value, text]) => outside(value, text, 12, -6))
    const widest = Math.max(0, ...this.ticks[axis].map(([, text]) => text.length))
    return [...numbers, outside(half, name, 28, 7 * widest - 12)]
  }

  delete() {
    for (const label of this.labels) label.remove()
    for (const part of [this.actor, this.mapper, this.poly]) part.delete()
  }
}

// ---------------------------------------------------------------------------- the view

class CloudView {
  constructor(model, stage, problem) {
    Object.assign(this, {model, stage, problem})
    this.orbit = new Orbit()
    this.count = 0
    this.stale = new Set(["data", "box", "look", "home"])
    this.resizing = new ResizeObserver(() => {
      this.stale.add("size")
      this.schedule()
    })
    this.resizing.observe(stage)
    this.onCamera = ({detail}) => this.follow(detail)
    window.addEventListener(CAMERA_EVENT, this.onCamera)
    this.onPrint = () => this.draw() // a canvas keeps what was drawn within the present task
    window.addEventListener("beforeprint", this.onPrint)
  }

  mark(...what) {
    for (const name of what) this.stale.add(name)
    this.schedule()
  }

  schedule() {
    if (this.frame || this.dead) return
    this.frame = requestAnimationFrame(() => {
      this.frame = null
      this.draw()
    })
  }

  /* Create all vtk.js objects, at the first frame that has a size. */
  build(vtk) {
    const {vtkRenderWindow, vtkRenderer} = vtk.Rendering.Core
    this.ratio = Math.min(window.devicePixelRatio || 1, MAX_PIXEL_RATIO)
    this.surface = vtk.Rendering.OpenGL.vtkRenderWindow.newInstance()
    const canvas = this.surface.getCanvas()
    // vtk.js uses this context. The shaders smooth edges; multisampling would cost a quarter of the
    // frame rate without a GPU.
    const context = canvas.getContext("webgl2", {antialias: false})
    if (!context) throw new Error("this browser offers no WebGL 2")
    canvas.addEventListener("webglcontextlost", () => this.rebuild(canvas))
    this.window = vtkRenderWindow.newInstance()
    this.renderer = vtkRenderer.newInstance()
    this.renderer.setBackground(0, 0, 0, 0) // transparent: the page's colour
    this.window.addRenderer(this.renderer)
    this.window.addView(this.surface)
    this.surface.setContainer(this.stage)
    this.box = new Box(vtk, this.renderer, this.stage)
    this.good = new Points(vtk, this.renderer, DISC, 1.5 * this.ratio)
    this.bad = new Points(vtk, this.renderer, CROSS, 6 * this.ratio)
    this.ring = new Points(vtk, this.renderer, RING, 24 * this.ratio)
  }

  ready() {
    if (this.window) return true
    const {vtk} = window
    try {
      if (!vtk) throw new Error("vtk.js is missing: the app must call pn.extension('vtk')")
      this.build(vtk)
      this.say("")
      return true
    } catch (error) {
      // After the loss of its graphics a browser offers none for a while.
      this.say(`The 3D cloud cannot be drawn: ${error.message}. It is tried again at the next change.`)
      return false
    }
  }

  say(text) {
    // Setting an equal text would make screen readers repeat it.
    if (this.problem.textContent !== text) this.problem.textContent = text
  }

  draw() {
    const {clientWidth: width, clientHeight: height} = this.stage
    if (width === 0 || height === 0 || this.dead || !this.ready()) return
    const {stale} = this
    if (this.atHome === undefined) stale.add("home") // not framed yet
    if (stale.has("data") && !this.readData()) return
    if (stale.has("box") || stale.has("home")) this.readBox()
    if (stale.has("look")) this.readLook()
    if (stale.has("data") || stale.has("selected")) this.placeRing()
    this.surface.setSize(Math.round(width * this.ratio), Math.round(height * this.ratio))
    if (stale.has("home") || (stale.has("size") && this.atHome)) this.goHome(width, height)
    stale.clear()
    this.placeCamera()
    this.sizePoints(height)
    const eye = this.orbit.eye()
    if (this.box.bounds) this.box.place(eye, this.orbit.projector(width, height), width, height)
    this.window.render()
    this.stage.dataset.points = this.count
    this.stage.dataset.camera = [...eye, ...this.orbit.focal].map((v) => v.toFixed(3)).join(" ")
  }

  /* Split the points into right and wrong ones; skip buffers whose lengths disagree. */
  readData() {
    const {positions, colors, pixels, wrong} = this.model
    const xyz = new Float32Array(positions ?? 0)
    const rgb = new Uint8Array(colors ?? 0)
    const mask = new Uint8Array(wrong ?? 0)
    const index = new Int32Array(pixels ?? 0)
    const count = xyz.length / 3
    if (rgb.length !== 3 * count || index.length !== count) return false
    if (mask.length !== 0 && mask.length !== count) return false
    Object.assign(this, {xyz, count, pixels: index})
    const isWrong = (_, i) => mask[(i / 3) | 0] === 1
    const isRight = (_, i) => !isWrong(_, i)
    const hasWrong = mask.includes(1)
    this.good.set(hasWrong ? xyz.filter(isRight) : xyz, hasWrong ? rgb.filter(isRight) : rgb)
    this.bad.set(hasWrong ? xyz.filter(isWrong) : new Float32Array(0))
    return true
  }

  /* Set the box to the server's bounds, or to those of the points as long as there are none. */
  readBox() {
    let {bounds} = this.model
    if (bounds.length !== 6 && this.count > 0) {
      bounds = [Infinity, -Infinity, Infinity, -Infinity, Infinity, -Infinity]
      this.xyz.forEach((value, i) => {
        const axis = 2 * (i % 3)
        bounds[axis] = Math.min(bounds[axis], value)
        bounds[axis + 1] = Math.max(bounds[axis + 1], value)
      })
    }
    if (bounds.length === 6) {
      this.box.set(bounds)
    } else {
      this.box.clear()
      this.atHome = undefined
    }
  }

  readLook() {
    const [ink, paper] = [channels(this.model.ink), channels(this.model.paper)]
    const faint = ink.map((value, k) => BOX_INK * value + (1 - BOX_INK) * paper[k])
    this.box.actor.getProperty().setColor(...faint)
    this.bad.actor.getProperty().setColor(...channels(this.model.wrong_color))
  }

  placeRing() {
    const marked = [this.model.selected, ...this.model.pinned]
    const at = marked.map((pixel) => this.pixels.indexOf(pixel)).filter((k) => k >= 0)
    this.ring.set(new Float32Array(at.flatMap((k) => [...this.xyz.slice(3 * k, 3 * k + 3)])))
  }

  goHome(width, height) {
    if (!this.box.bounds) return
    this.orbit.home(this.box.bounds, width, height)
    this.atHome = true
  }

  /* Send the camera to the linked clouds of the page; each component has its own module. */
  share() {
    const {link} = this.model
    if (!link) return
    const detail = {link, from: this, orbit: this.orbit, atHome: this.atHome}
    window.dispatchEvent(new CustomEvent(CAMERA_EVENT, {detail}))
  }

  follow({link, from, orbit, atHome}) {
    if (from === this || !link || link !== this.model.link) return
    this.orbit.follow(orbit)
    this.atHome = atHome
    this.schedule()
  }

  /* Return to the home view, with all linked clouds. */
  homeByHand() {
    this.goHome(this.stage.clientWidth, this.stage.clientHeight)
    this.share()
    this.schedule()
  }

  placeCamera() {
    const camera = this.renderer.getActiveCamera()
    camera.setViewAngle(VIEW_ANGLE_DEG)
    camera.setFocalPoint(...this.orbit.focal)
    camera.setPosition(...this.orbit.eye())
    camera.setViewUp(0, 0, 1)
    this.renderer.resetCameraClippingRange()
  }

  /* Diameter in CSS pixels of a point at a depth of 1 m. */
  pointScale(height) {
    return (POINT_SIZE * this.model.spacing_m * height) / (2 * HALF_VIEW)
  }

  sizePoints(height) {
    const scale = this.pointScale(height) * this.ratio
    this.good.actor.getProperty().setPointSize(scale)
    this.bad.actor.getProperty().setPointSize(0.9 * scale)
    this.ring.actor.getProperty().setPointSize(2.2 * scale)
  }

  /* Index of the point under (x, y): the front one of those whose disc covers it, which is the
   * visible one; else the nearest within PICK_PX; else -1. */
  pick(x, y) {
    const {clientWidth: width, clientHeight: height} = this.stage
    const project = this.orbit.projector(width, height)
    const scale = this.pointScale(height)
    const out = [0, 0, 0]
    let [front, frontDepth, nearest, nearestPx] = [-1, Infinity, -1, PICK_PX]
    for (let i = 0; i < this.count; i++) {
      project(this.xyz[3 * i], this.xyz[3 * i + 1], this.xyz[3 * i + 2], out)
      if (out[2] <= 0) continue
      const away = Math.hypot(out[0] - x, out[1] - y)
      if (away < scale / out[2] / 2 && out[2] < frontDepth) [front, frontDepth] = [i, out[2]]
      if (away <= nearestPx) [nearest, nearestPx] = [i, away]
    }
    return front >= 0 ? front : nearest
  }

  select(x, y) {
    const at = this.pick(x, y)
    if (at >= 0) this.model.selected = this.pixels[at]
  }

  moved() {
    this.atHome = false
    this.share()
    this.schedule()
  }

  turn(azimuth, elevation) {
    this.orbit.turn(azimuth, elevation)
    this.moved()
  }

  zoom(factor) {
    this.orbit.zoom(factor)
    this.moved()
  }

  pan(dx, dy) {
    this.orbit.pan(dx, dy, this.stage.clientHeight)
    this.moved()
  }

  /* Return the picture with tick labels and caption as a canvas with `ratio` pixels for each of
   * the page's, and its size on the page. */
  picture(ratio) {
    this.draw()
    if (!this.window) throw new Error(this.problem.textContent || "the cloud is not drawn yet")
    const own = this.ratio
    this.ratio = ratio
    try {
      return this.drawn()
    } finally {
      this.ratio = own
      this.draw()
    }
  }

  /* The WebGL canvas is copied in the task that drew it, before the browser may clear it. */
  drawn() {
    this.draw()
    const source = this.surface.getCanvas()
    const {clientWidth: width, clientHeight: height} = this.stage.parentNode
    const canvas = element("canvas", {width: source.width, height: Math.round(height * this.ratio)})
    const pen = canvas.getContext("2d")
    const style = getComputedStyle(this.stage.parentNode)
    pen.fillStyle = style.backgroundColor
    pen.fillRect(0, 0, canvas.width, canvas.height)
    pen.drawImage(source, 0, 0)
    pen.scale(this.ratio, this.ratio)
    pen.fillStyle = style.color
    pen.font = `11px ${style.fontFamily}`
    pen.textBaseline = "middle"
    for (const {x, y, anchor, text} of this.box.shown) {
      pen.fillText(text, x + anchor * pen.measureText(text).width, y)
    }
    this.model.caption.split("\n").forEach((line, k) => {
      pen.fillText(line, 8, this.stage.clientHeight + LINE_PX * (k + 0.5), width - 16)
    })
    return {canvas, width, height}
  }

  /* vtk.js does not survive the loss of its context, for example when a laptop switches GPUs. */
  rebuild(canvas) {
    if (this.surface?.getCanvas() !== canvas) return
    this.release()
    this.mark("data", "box", "look")
  }

  delete() {
    this.dead = true
    this.resizing.disconnect()
    window.removeEventListener(CAMERA_EVENT, this.onCamera)
    window.removeEventListener("beforeprint", this.onPrint)
    cancelAnimationFrame(this.frame)
    this.release()
  }

  release() {
    const {surface} = this
    if (!this.window) return
    const context = surface.getCanvas().getContext("webgl2")
    for (const part of [this.good, this.bad, this.ring, this.box]) part.delete()
    surface.setContainer(null)
    for (const part of [this.renderer, this.window, surface]) part.delete()
    this.surface = this.window = null
    // Browsers allow few contexts; garbage collection comes too late.
    context.getExtension("WEBGL_lose_context")?.loseContext()
  }
}

// ---------------------------------------------------------------------------- pointer and keyboard

/* One pointer rotates (with Shift or another button: pans); two zoom and pan. */
function listenToPointers(stage, view) {
  const held = new Map()
  let travelled = 0

  const place = (event) => {
    const {left, top} = stage.getBoundingClientRect()
    return [event.clientX - left, event.clientY - top]
  }
  const middle = () => {
    const points = [...held.values()]
    return [0, 1].map((k) => points.reduce((sum, point) => sum + point[k], 0) / points.length)
  }
  const gap = () => {
    const [a, b] = [...held.values()]
    return Math.hypot(a[0] - b[0], a[1] - b[1]) || 1
  }

  stage.addEventListener("pointerdown", (event) => {
    stage.setPointerCapture(event.pointerId)
    if (held.size === 0) travelled = 0
    held.set(event.pointerId, place(event))
  })
  stage.addEventListener("pointermove", (event) => {
    if (!held.has(event.pointerId)) return
    const [before, gapBefore] = [middle(), held.size === 2 ? gap() : 1]
    held.set(event.pointerId, place(event))
    const [dx, dy] = middle().map((value, k) => value - before[k])
    travelled += Math.hypot(dx, dy) + (held.size > 1 ? CLICK_MOVE_PX : 0)
    if (travelled < CLICK_MOVE_PX) return
    if (held.size === 2) view.zoom(gap() / gapBefore)
    if (held.size > 1 || event.shiftKey || event.buttons > 1) view.pan(dx, dy)
    else view.turn((-dx * Math.PI) / stage.clientWidth, (dy * Math.PI) / stage.clientHeight)
  })
  const release = (event) => {
    if (!held.delete(event.pointerId)) return
    const click = event.type === "pointerup" && event.button === 0 && held.size === 0
    if (click && travelled < CLICK_MOVE_PX) view.select(...place(event))
  }
  stage.addEventListener("pointerup", release)
  stage.addEventListener("pointercancel", release)
  stage.addEventListener("contextmenu", (event) => event.preventDefault())
  stage.addEventListener("wheel", (event) => {
    event.preventDefault()
    const pixels = event.deltaY * (event.deltaMode === 1 ? 16 : 1)
    view.zoom(Math.exp(-clamp(pixels, -200, 200) / 500))
  }, {passive: false})
}

function listenToKeys(stage, view) {
  const actions = {
    ArrowLeft: () => view.turn(-KEY_TURN, 0),
    ArrowRight: () => view.turn(KEY_TURN, 0),
    ArrowUp: () => view.turn(0, KEY_TURN),
    ArrowDown: () => view.turn(0, -KEY_TURN),
    "+": () => view.zoom(KEY_ZOOM),
    "=": () => view.zoom(KEY_ZOOM), // the plus key without shift
    "-": () => view.zoom(1 / KEY_ZOOM),
    0: () => view.homeByHand(),
    Home: () => view.homeByHand(),
  }
  stage.addEventListener("keydown", (event) => {
    const action = actions[event.key]
    if (!action || event.ctrlKey || event.metaKey || event.altKey) return
    event.preventDefault()
    event.stopPropagation()
    action()
  })
}

// ---------------------------------------------------------------------------- Panel

// Panel may render a component again without announcing the removal of its first view.
const views = new WeakMap()

export function render({model}) {
  views.get(model)?.delete()
  const stage = element("div", {class: "stage", role: "img", tabindex: "0"})
  const caption = element("div", {class: "caption"})
  const problem = element("div", {class: "problem", role: "alert"})
  const view = new CloudView(model, stage, problem)
  const tools = element("div", {class: "tools", role: "group", "aria-label": "3D view"},
    button("Home view (0)", HOME_ICON, () => view.homeByHand()))
  const root = element("div", {class: "cloud"}, element("style", {}, STYLE),
    stage, caption, tools, problem)
  root.picture = (ratio) => view.picture(ratio) // for downloads.js
  views.set(model, view)
  listenToPointers(stage, view)
  listenToKeys(stage, view)

  const write = () => {
    root.style.setProperty("--ink", model.ink)
    root.style.setProperty("--paper", model.paper)
    stage.setAttribute("aria-label", model.label)
    caption.textContent = model.caption
  }
  write()
  model.on(["label", "caption", "ink", "paper"], write)
  model.on(["ink", "paper", "wrong_color"], () => view.mark("look"))
  model.on(["positions", "colors", "pixels", "wrong"], () => view.mark("data"))
  model.on(["selected", "pinned"], () => view.mark("selected"))
  model.on("spacing_m", () => view.schedule())
  model.on("bounds", () => view.mark("box"))
  model.on(["scene_id", "home"], () => view.mark("home"))
  model.on("remove", () => view.delete())
  return root
}
