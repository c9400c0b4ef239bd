// Faint where the surface hides it.
in vec4 v_color;
in vec2 v_corner;
flat in float v_depth;
uniform sampler2D u_depth;  // depth times alpha, and alpha
uniform float u_behind;     // how far inside the surface counts as on it
layout(location = 0) out vec4 o_color;

void main() {
  float away = dot(v_corner, v_corner);
  if (away > 1.0) discard;
  vec4 surface = texelFetch(u_depth, ivec2(gl_FragCoord.xy) / DEPTH_SCALE, 0);
  float alpha = v_color.a * (1.0 - smoothstep(0.7, 1.0, away));
  if (v_depth > 0.0 && surface.a > 0.5 && v_depth > surface.x / surface.a + u_behind) alpha *= FAINT;
  o_color = vec4(v_color.rgb * alpha, alpha);
}
