// The finished sum over its background.
uniform sampler2D u_image;
uniform vec3 u_background;
layout(location = 0) out vec4 o_color;

void main() {
  vec4 image = texelFetch(u_image, ivec2(gl_FragCoord.xy), 0);
  o_color = vec4(image.rgb + (1.0 - image.a) * u_background, 1.0);
}
