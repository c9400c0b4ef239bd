// Functions of all shaders.

// Place of a texel in a texture of WIDTH columns.
ivec2 at(int texel) {
  return ivec2(texel % WIDTH, texel / WIDTH);
}

// Squared distance at which alpha is 1 / 255.
float extent_of(float opacity) {
  float depth = max(log(255.0 * opacity), 0.0);
  return 4.0 * depth / (1.0 + sqrt(1.0 + 4.0 * SHARPNESS * depth));
}
