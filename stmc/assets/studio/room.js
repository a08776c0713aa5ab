// The light and the floor of the room. Knows no figure.

import { Color, DirectionalLight, DoubleSide, HemisphereLight, Mesh, PlaneGeometry, ShaderMaterial, ShadowMaterial, Vector2 } from "./vendor/three.module.min.js";

export function lit(scene) {
  scene.add(new HemisphereLight(0xffffff, 0xa9adb8, 2.1));
  const light = new DirectionalLight(0xffffff, 2.0);
  light.castShadow = true;
  light.shadow.mapSize.set(1024, 1024);
  Object.assign(light.shadow.camera, { left: -2, right: 2, top: 2, bottom: -2, near: 0.5, far: 12 });
  light.shadow.radius = 5;
  light.shadow.bias = -0.0005;
  scene.add(light, light.target);
  return light;
}

// Half-metre tiles that fade away from where the figure is; every other line is a metre's.
export function floorOf(scene) {
  const lines = new ShaderMaterial({
    transparent: true,
    depthWrite: false,
    side: DoubleSide,
    uniforms: { ink: { value: new Color() }, middle: { value: new Vector2() } },
    vertexShader: `varying vec2 place;
      void main() { vec4 world = modelMatrix * vec4(position, 1.0); place = world.xz; gl_Position = projectionMatrix * viewMatrix * world; }`,
    fragmentShader: `varying vec2 place; uniform vec3 ink; uniform vec2 middle;
      float lines(float tile) { vec2 at = place / tile; vec2 near = abs(fract(at - 0.5) - 0.5) / fwidth(at); return 1.0 - min(min(near.x, near.y), 1.0); }
      void main() {
        float fade = 1.0 - smoothstep(1.5, 9.0, length(place - middle));
        gl_FragColor = vec4(ink, fade * (0.55 * lines(1.0) + 0.22 * lines(0.5)));
        #include <colorspace_fragment>
      }`,
  });
  const grid = new Mesh(new PlaneGeometry(18, 18), lines);
  const shade = new Mesh(new PlaneGeometry(6, 6), new ShadowMaterial({ opacity: 0.22 })); // as far as shadows reach
  shade.receiveShadow = true;
  for (const plane of [grid, shade]) {
    plane.rotation.x = -Math.PI / 2;
    scene.add(plane);
  }
  shade.position.y = 0.001;
  return {
    centre({ x, z }) {
      for (const plane of [grid, shade]) plane.position.set(x, plane.position.y, z);
      lines.uniforms.middle.value.set(x, z);
    },
    theme({ line, shadow }) {
      lines.uniforms.ink.value.set(line);
      shade.material.opacity = shadow;
    },
  };
}
