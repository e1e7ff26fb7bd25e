/* What an application keeps for a controller. */
#include "gpmpc.h"

gpmpc_controller controller = {0};
gpmpc_reference reference = {0};
