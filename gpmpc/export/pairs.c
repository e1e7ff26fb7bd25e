/* ------------------------------------------------------------------------------------
   Doubled digits: what a sum or a product rounds off is kept in a second number, as by
   Ogita, Rump and Oishi (Accurate sum and dot product, 2005). Options by which a
   compiler reorders sums, such as -ffast-math, would lose it.
   --------------------------------------------------------------------------------- */

typedef struct {
    real high;
    real low; /* what high rounds off, itself rounded */
} Pair;

static Pair pair_of(real high, real low)
{
    Pair pair;
    pair.high = high;
    pair.low = low;
    return pair;
}

static real rounded(Pair a) { return a.high + a.low; }

static void add(Pair *sum, real a)
{
    real total = sum->high + a;
    real part = total - sum->high;
    sum->low += (sum->high - (total - part)) + (a - part);
    sum->high = total;
}

/* sum <- sum + factor a */
static void add_multiple(Pair *sum, real factor, Pair a)
{
    real rounded_product = factor * a.high;
    sum->low += FMA(factor, a.high, -rounded_product) + factor * a.low;
    add(sum, rounded_product);
}

/* The same number, its second part as small as can be. */
static Pair normalised(Pair a)
{
    real high = a.high + a.low;
    return pair_of(high, a.low - (high - a.high));
}
