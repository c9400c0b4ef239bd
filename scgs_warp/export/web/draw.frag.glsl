in vec2 v_corner;
flat in vec4 v_color;
layout(location = 0) out vec4 o_color;

void main() {
  float u = 0.5 * dot(v_corner, v_corner);
  float alpha = min(0.999, v_color.a * exp(-u * (1.0 + SHARPNESS * u)));
  if (alpha < 1.0 / 255.0) discard;
  o_color = vec4(v_color.rgb * alpha, alpha);
}
