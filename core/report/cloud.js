// Draws the point cloud of a report, and turns it by mouse, touch and keys. x is to the right of the
// sensor, y away from it, z up; the first view has radius 1.
"use strict"

const HOME = {turn: 0.5, tilt: 0.35, zoom: 1, x: 0, y: 0}
const DISTANCE = 4
const MOST_PX = 12 // side of a point
const FAR = 1e9

function start(canvas) {
  const {xyz, rgb, unit, spacing} = canvas.dataset
  const points = Float32Array.from(new Int16Array(bytes(xyz).buffer), (steps) => steps * unit)
  const colors = packed(bytes(rgb))
  const view = {...HOME}
  let waits = false
  const update = (change) => {
    Object.assign(view, change)
    view.tilt = clamp(view.tilt, -Math.PI / 2, Math.PI / 2)
    view.zoom = clamp(view.zoom, 0.1, 50)
    if (!waits) requestAnimationFrame(() => { waits = false; draw(canvas, points, colors, spacing, view) })
    waits = true
  }
  listen(canvas, view, update)
  new ResizeObserver(() => update({})).observe(canvas)
}

const clamp = (value, low, high) => Math.min(Math.max(value, low), high)
const bytes = (text) => Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0))

function packed(rgb) { // as the pixels of a canvas: opaque, red in the lowest byte
  const at = (_, i) => 0xff000000 | (rgb[3 * i + 2] << 16) | (rgb[3 * i + 1] << 8) | rgb[3 * i]
  return Uint32Array.from({length: rgb.length / 3}, at)
}

function draw(canvas, points, colors, spacing, view) {
  const sharp = Math.min(devicePixelRatio, 2)
  const width = (canvas.width = Math.max(1, Math.round(canvas.clientWidth * sharp)))
  const height = (canvas.height = Math.max(1, Math.round(canvas.clientHeight * sharp)))
  const picture = new ImageData(width, height)
  const shown = new Uint32Array(picture.data.buffer)
  const depths = new Float32Array(width * height).fill(FAR)
  const [cosTurn, sinTurn] = [Math.cos(view.turn), Math.sin(view.turn)]
  const [cosTilt, sinTilt] = [Math.cos(view.tilt), Math.sin(view.tilt)]
  const scale = 0.38 * DISTANCE * Math.min(width, height) * view.zoom
  const [middleX, middleY] = [width / 2 + view.x * sharp, height / 2 + view.y * sharp]
  for (let i = 0; i < colors.length; i++) {
    const [x, y, z] = [points[3 * i], points[3 * i + 1], points[3 * i + 2]]
    const away = sinTurn * x + cosTurn * y
    const depth = DISTANCE + cosTilt * away - sinTilt * z
    if (depth < 0.1) continue // behind the eye
    const side = clamp(Math.ceil((spacing * scale) / depth), sharp, MOST_PX)
    const left = Math.round(middleX + (scale * (cosTurn * x - sinTurn * y)) / depth - side / 2)
    const top = Math.round(middleY - (scale * (sinTilt * away + cosTilt * z)) / depth - side / 2)
    for (let row = Math.max(top, 0); row < Math.min(top + side, height); row++) {
      for (let col = Math.max(left, 0); col < Math.min(left + side, width); col++) {
        const at = row * width + col
        if (depth >= depths[at]) continue
        depths[at] = depth
        shown[at] = colors[i]
      }
    }
  }
  canvas.getContext("2d").putImageData(picture, 0, 0)
}

function listen(canvas, view, update) {
  const held = new Map() // places of fingers, or of the mouse
  const spread = () => {
    const [[x, y], [otherX, otherY]] = [...held.values()]
    return Math.hypot(x - otherX, y - otherY) || 1
  }
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId)
    held.set(event.pointerId, [event.clientX, event.clientY])
  })
  canvas.addEventListener("pointermove", (event) => {
    const before = held.get(event.pointerId)
    if (!before || held.size > 2) return
    const apart = held.size === 2 && spread()
    const [dx, dy] = [event.clientX - before[0], event.clientY - before[1]]
    held.set(event.pointerId, [event.clientX, event.clientY])
    if (apart) update({zoom: (view.zoom * spread()) / apart, x: view.x + dx / 2, y: view.y + dy / 2})
    else if (event.shiftKey || event.buttons > 1) update({x: view.x + dx, y: view.y + dy})
    else update({turn: view.turn + dx / 150, tilt: view.tilt + dy / 150})
  })
  for (const end of ["pointerup", "pointercancel"]) {
    canvas.addEventListener(end, (event) => held.delete(event.pointerId))
  }
  canvas.addEventListener("contextmenu", (event) => event.preventDefault())
  canvas.addEventListener("wheel", (event) => {
    if (document.activeElement !== canvas) return // the page scrolls
    event.preventDefault()
    update({zoom: view.zoom * Math.exp(-clamp(event.deltaY, -200, 200) / 500)})
  }, {passive: false})
  const actions = {
    ArrowLeft: () => ({turn: view.turn - 0.1}),
    ArrowRight: () => ({turn: view.turn + 0.1}),
    ArrowUp: () => ({tilt: view.tilt - 0.1}),
    ArrowDown: () => ({tilt: view.tilt + 0.1}),
    "+": () => ({zoom: view.zoom * 1.2}),
    "=": () => ({zoom: view.zoom * 1.2}), // the plus key without shift
    "-": () => ({zoom: view.zoom / 1.2}),
    0: () => HOME,
    Home: () => HOME,
  }
  canvas.addEventListener("keydown", (event) => {
    if (!(event.key in actions) || event.ctrlKey || event.metaKey || event.altKey) return
    event.preventDefault()
    update(actions[event.key]())
  })
}

const cloud = document.querySelector("#cloud")
if (cloud) start(cloud)
